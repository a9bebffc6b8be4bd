"""The physical layer ``shannon`` sends at capacity, as the paper does, or close to it.

A packet takes b / log2(1 + γ̄) channel uses of a slot's W τ_o, and what it does not fill is the next
one's.
"""

import dataclasses
import functools
import math

from hjepa_cli.config.schema import NrSettings, RadioSettings
from hjepa_cli.core.radio.capacity import late_slots, slot_capacity
from hjepa_cli.core.radio.channel import outage_probability
from hjepa_cli.core.radio.coding import packet_uses, round_errors
from hjepa_cli.core.radio.phy.equal_parts import equal_devices
from hjepa_cli.core.radio.phy.phy import Carried, Noise, Phy, Reports

INNOVATION_BITS = 8  # of a report


@dataclasses.dataclass(frozen=True)
class Shannon:
    """Carries packets in W hertz and slots of τ_o seconds.

    ``overhead_bits`` come to each packet and each report, ``block_error`` above 0 makes codes
    finite, and ``harq_rounds`` copies of a packet are combined; laws with a formula know neither.
    """

    bandwidth_hz: float
    slot_s: float
    overhead_bits: int = 0
    block_error: float = 0.0
    harq_rounds: int = 1

    @classmethod
    def of(cls, radio: RadioSettings, nr: NrSettings, slot_s: float) -> "Shannon":
        """Return that of the settings."""
        coding = radio.overhead_bits, radio.block_error, radio.harq_rounds
        return cls(radio.bandwidth_hz, slot_s, *coding)

    @functools.lru_cache(maxsize=4096)  # noqa: B019 - small, frozen, and asked again and again
    def carries(
        self, payload_bits: float, snr_db: float, *, dynamic: bool | None = None
    ) -> Carried:
        """Return what slots carry; grants cost nothing here."""
        c = float(slot_capacity(payload_bits, self.bandwidth_hz, self.slot_s, snr_db))
        bits = payload_bits + self.overhead_bits
        errors = round_errors(bits, snr_db, self.block_error, self.harq_rounds)
        late = float(late_slots(c))
        room = self._slot_uses / packet_uses(bits, snr_db, self.block_error)
        return Carried(
            packets_per_slot=c,
            transmissions_per_slot=room,
            resource_transmissions=room,
            round_errors=errors,
            latency_s=self.slot_s * max(late, 1.0),
            late_slots=late,
            allocation_hz=self.bandwidth_hz,
            described=f"a packet takes {1 / c:.3g} slots",
        )

    def shared_by(self, delivery: float, payload_bits: float, snr_db: float, noise: Noise) -> int:
        """Return N of :func:`~hjepa_cli.core.radio.phy.equal_parts.equal_devices`."""
        band = self.bandwidth_hz, self.slot_s, snr_db
        return int(equal_devices(delivery, payload_bits, *band, noise=noise))

    def delivery_alone(self, payload_bits: float, snr_db: float) -> float:
        """Return 1 − ε at R̄ = b/τ_o over the whole band."""
        rate_bps = payload_bits / self.slot_s
        return float(1.0 - outage_probability(rate_bps, self.bandwidth_hz, snr_db))

    def reports(self, devices: int, snr_db: float) -> Reports:
        """Return short packets of 8 bits for how far and ⌈log2 N⌉ for who."""
        bits = report_bits(devices) + self.overhead_bits
        return Reports(bits, packet_uses(bits, snr_db, self.block_error) / self._slot_uses)

    @property
    def _slot_uses(self) -> float:
        return self.bandwidth_hz * self.slot_s


def report_bits(devices: int) -> int:
    """Return the bits of a report in a cell of N devices: 8 for how far, ⌈log2 N⌉ for who."""
    return INNOVATION_BITS + math.ceil(math.log2(max(devices, 1)))


SHANNON = Phy(
    name="shannon",
    help="capacity",
    layer=Shannon.of,
    uses=("radio.overhead_bits", "radio.block_error", "radio.harq_rounds"),
)
