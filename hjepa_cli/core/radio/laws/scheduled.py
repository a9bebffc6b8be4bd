"""The law ``scheduled``: a scheduler that knows what each loop needs hands out resource blocks.

How many devices one block carries is found by simulation; here is what that makes of a cell.
"""

import dataclasses

from hjepa_cli.core.radio.capacity import whole_devices
from hjepa_cli.core.radio.cell import Cell
from hjepa_cli.core.radio.channel import ROUNDING
from hjepa_cli.core.radio.laws.law import HELD_LINKS, Row, SharingLaw
from hjepa_cli.core.radio.phy.phy import Carried
from hjepa_cli.plugins import SCHEDULERS

SCHEDULED = SharingLaw(
    name="scheduled",
    help="as a scheduler decides",
    uses=(
        *("radio.schedulers", "radio.uncertainty", "radio.seeds", "radio.power_margin_db"),
        *("radio.coherence_slots", "radio.overhead_bits", "radio.block_error"),
        *("radio.harq_rounds", "radio.topology", "radio.scenario", "radio.carrier_ghz"),
        *("radio.power_dbm", "radio.noise_figure_db", "radio.fading", "radio.speed_m_s"),
        *("radio.delay_spread_s", "nr.reports", *HELD_LINKS),
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
    """Cuts a cell's slots into blocks of one transmission each, reports paid for.

    Loads were found at ``acceptable_score``.
    """

    cell: Cell
    acceptable_score: float

    def fits(self, scheduler: str, payload_bits: int, snr_db: float) -> bool:
        """Tell whether a slot holds a packet, up to rounding."""
        carried = self._carried(scheduler, payload_bits, snr_db)
        return carried.transmissions_per_slot >= 1 - ROUNDING

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
        carried = self._carried(scheduler, payload_bits, snr_db)
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
            **carried.details,
            "reason": None,
        }
        if found is None:
            return row | {"reason": carried.described}
        ends = (found.load, *found.interval)
        devices, *interval = [self._devices(load, found, carried, snr_db) for load in ends]
        row |= {
            "load_per_block": found.load,
            "load_ci95": list(found.interval),
            "at_least": found.at_least,
            "packets_per_block_slot": found.packets_per_slot,
            "reports_per_block_slot": found.reports_per_slot,
            "curve": [{"load": load, "score": score} for load, score in found.points],
            "devices_by_seed": [
                self._devices(one.load, one, carried, snr_db) for one in found.parts or [found]
            ],
            "devices": devices,
            "devices_ci95": interval,
        }
        if found.load == 0:
            score = f"{self.acceptable_score:g}"
            return row | {"reason": f"below {score} even with one device per block"}
        reports = self.cell.phy.reports(devices, snr_db)
        packets = found.packets_per_slot * (payload_bits + self.cell.phy.overhead_bits)
        bits = packets + found.reports_per_slot * reports.bits
        row["bits_per_s"] = bits / found.load / self.cell.slot_s
        if (limit := self.cell.limit_bits_per_s) > 0:
            row["ratio_to_limit"] = row["bits_per_s"] / limit
        if found.reports_per_slot:
            blocks = devices / found.load
            each = found.reports_per_slot * reports.share_each
            row["reports_share"] = min(reports.share_reserved + blocks * each, 1.0)
        if devices == 0:
            row["reason"] = "fewer than one device"
        return row

    def _devices(self, load: float, found: SupportedLoad, carried: Carried, snr_db: float) -> int:
        """Return N = ⌊load · blocks⌋ of a slot, what reports take left out; that depends on N.

        More devices never leave more blocks, so that N is what a bisection finds.
        """
        most = int(whole_devices(load * carried.transmissions_per_slot))
        if not found.reports_per_slot or not most:
            return most
        few, many = 0, most  # devices that fit, and that may not
        while few < many:
            middle = (few + many + 1) // 2
            if self._fitting(middle, load, found, carried, snr_db) >= middle:
                few = middle
            else:
                many = middle - 1
        return few

    def _fitting(
        self, devices: int, load: float, found: SupportedLoad, carried: Carried, snr_db: float
    ) -> int:
        """Return how many fit where reports take what those of so many devices do."""
        reports = self.cell.phy.reports(devices, snr_db)
        each = 1 / carried.resource_transmissions + found.reports_per_slot * reports.share_each
        blocks = max(1.0 - reports.share_reserved, 0.0) / each
        return int(whole_devices(load * min(blocks, carried.transmissions_per_slot)))

    def _carried(self, scheduler: str, payload_bits: int, snr_db: float) -> Carried:
        granted = None if SCHEDULERS[scheduler].in_turn else True
        return self.cell.phy.carries(payload_bits, snr_db, dynamic=granted)
