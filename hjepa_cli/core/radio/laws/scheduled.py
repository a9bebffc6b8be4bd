"""The law ``scheduled``: a scheduler that knows what each loop needs hands out resource blocks.

How many devices one block carries is found by simulation; here is what that makes of a cell.
"""

import dataclasses

from hjepa_cli.config.schema import RadioSettings
from hjepa_cli.core.radio.capacity import Cell, whole_devices
from hjepa_cli.core.radio.channel import ROUNDING
from hjepa_cli.core.radio.coding import packet_uses
from hjepa_cli.core.radio.laws.law import Row, SharingLaw
from hjepa_cli.core.radio.uplink import report_bits

SCHEDULED = SharingLaw(
    name="scheduled",
    help="as a scheduler decides",
    uses=(
        *("radio.schedulers", "radio.uncertainty", "radio.seeds", "radio.power_margin_db"),
        *("radio.coherence_slots", "radio.overhead_bits", "radio.block_error"),
        *("radio.harq_rounds", "radio.topology", "radio.scenario", "radio.carrier_ghz"),
        *("radio.power_dbm", "radio.noise_figure_db"),
    ),
)


@dataclasses.dataclass(frozen=True)
class SupportedLoad:
    """Holds the load at which the score falls to the acceptable one.

    Attributes:
        load: devices per block, interpolated between the simulated ones; 0 where not even a block
            per device suffices.
        interval: 95 %, over devices of one seed or over seeds.
        at_least: still acceptable at the largest load tried.
        packets_per_slot, reports_per_slot: per block, at the nearest load inside.
        points: (load, score) as simulated, ascending.
        parts: of each seed, where this is an average over seeds.
    """

    load: float
    interval: tuple[float, float]
    at_least: bool
    packets_per_slot: float
    reports_per_slot: float
    points: tuple[tuple[float, float], ...]
    parts: tuple["SupportedLoad", ...] = ()


@dataclasses.dataclass(frozen=True)
class ScheduledBand:
    """Cuts a cell's slots into blocks of one packet each, reports paid for.

    ``radio`` says how packets are coded, and loads were found at ``acceptable_score``.
    """

    cell: Cell
    radio: RadioSettings
    acceptable_score: float

    def fits(self, payload_bits: int, snr_db: float) -> bool:
        """Tell whether a slot holds a packet, up to rounding."""
        return self._slots_per_packet(payload_bits, snr_db) <= 1 + ROUNDING

    def row(
        self,
        found: SupportedLoad | None,
        method: str,
        scheduler: str,
        payload_bits: int,
        snr_db: float,
    ) -> Row:
        """Count one method's devices under one scheduler at one SNR.

        ``found`` is the load of a block, or ``None`` where a packet does not fit into a slot.
        """
        row: Row = {
            "snr_db": snr_db,
            "method": method,
            "scheduler": scheduler,
            "devices": 0,
            "devices_ci95": [0, 0],
            "at_least": False,
            "bits_per_s": None,
            "ratio_to_limit": None,
            "bits_per_transmission": payload_bits,
            "reason": None,
        }
        if found is None:
            slots = self._slots_per_packet(payload_bits, snr_db)
            return row | {"reason": f"a packet takes {slots:.3g} slots"}
        ends = (found.load, *found.interval)
        devices, *interval = [self._devices(load, found, payload_bits, snr_db) for load in ends]
        row |= {
            "load_per_block": found.load,
            "load_ci95": list(found.interval),
            "at_least": found.at_least,
            "packets_per_block_slot": found.packets_per_slot,
            "reports_per_block_slot": found.reports_per_slot,
            "curve": [{"load": load, "score": score} for load, score in found.points],
            "devices_by_seed": [
                self._devices(one.load, one, payload_bits, snr_db) for one in found.parts or [found]
            ],
            "devices": devices,
            "devices_ci95": interval,
        }
        if found.load == 0:
            score = f"{self.acceptable_score:g}"
            return row | {"reason": f"below {score} even with one device per block"}
        overhead_bits = self.radio.overhead_bits
        packets = found.packets_per_slot * (payload_bits + overhead_bits)
        reports = found.reports_per_slot * (report_bits(devices) + overhead_bits)
        row["bits_per_s"] = (packets + reports) / found.load / self.cell.slot_s
        if (limit := self.cell.limit_bits_per_s) > 0:
            row["ratio_to_limit"] = row["bits_per_s"] / limit
        if devices == 0:
            row["reason"] = "fewer than one device"
        return row

    def _devices(self, load: float, found: SupportedLoad, payload_bits: int, snr_db: float) -> int:
        """Return N = ⌊load · slot ÷ (packet + reports)⌋; the size of reports depends on N."""
        uses, devices = self._uses(payload_bits, snr_db), 0
        guess = int(whole_devices(load * self._slot_uses / uses))
        for _ in range(5):
            if guess == devices:
                break
            devices = guess
            reports = found.reports_per_slot * self._uses(report_bits(devices), snr_db)
            guess = int(whole_devices(load * self._slot_uses / (uses + reports)))
        return guess

    def _slots_per_packet(self, payload_bits: int, snr_db: float) -> float:
        return self._uses(payload_bits, snr_db) / self._slot_uses

    def _uses(self, bits: int, snr_db: float) -> float:
        """Return the channel uses of ``bits`` with the overhead of a packet."""
        sent_bits = bits + self.radio.overhead_bits
        return packet_uses(sent_bits, snr_db, self.radio.block_error)

    @property
    def _slot_uses(self) -> float:
        return self.cell.bandwidth_hz * self.cell.slot_s
