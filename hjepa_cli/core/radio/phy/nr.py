"""The physical layer ``nr`` is a 5G uplink, with all that it costs to send a short packet.

One layer of PUSCH with transform precoding (DFT-s-OFDM) and mapping type B: what a packet of b bits
takes is a whole number of PRBs over some symbols of a carrier's slot, of which reference signals,
headers and CRC take their part. Block error rates are Sionna's
(:mod:`~hjepa_cli.core.radio.phy.block_errors`); combining of repetitions is ours.
"""

import dataclasses
import functools
import math
from collections.abc import Iterator

import numpy as np

from hjepa_cli.config.schema import NrSettings, RadioSettings
from hjepa_cli.core.arrays import Floats, Integers
from hjepa_cli.core.radio.capacity import parse_snr
from hjepa_cli.core.radio.channel import ROUNDING
from hjepa_cli.core.radio.doppler import doppler_hz, power_correlation
from hjepa_cli.core.radio.phy import block_errors
from hjepa_cli.core.radio.phy.numerology import Carrier
from hjepa_cli.core.radio.phy.phy import Carried, Noise, Phy, Reports
from hjepa_cli.core.radio.phy.transport_block import (
    SLOT_SYMBOLS,
    SUBCARRIERS,
    TransportBlock,
    data_elements_per_prb,
    transport_block,
)
from hjepa_cli.errors import UsageError

NEVER = 1e-30  # a share of packets
QUANTILES = 64  # of a fade that was reported, and of the fade at the time of sending
FADES = 1024  # quantiles of Rayleigh fading
# A report is looked for this often, in slots of the loop; see radio/uplink.py.
REPORT_PERIOD = 8
# PUCCH format 0 (TS 38.211, clause 6.3.2.3): two symbols of one PRB hold 12 cyclic shifts, of which
# every other one is used, so that the paths of a hall do not mix them up.
PUCCH_SYMBOLS, PUCCH_SHIFTS = 2, 6
PUCCH_BITS = 2
CONTENTION = math.e  # a slotted ALOHA channel carries 1/e at best
GRANT_BITS, GRANT_HEADER_BITS, GRANT_SYMBOLS = 8, 16, 4


@dataclasses.dataclass(frozen=True)
class Allocation:
    """Holds what one transport block of a packet is sent on.

    Attributes:
        row: of its MCS among those with error rates.
        prbs, block: its width, and what it carries.
        segments: blocks that the packet is cut into.
        left: error rates after one, two, … combined transmissions.
    """

    row: int
    prbs: int
    block: TransportBlock
    segments: int
    left: Floats


class NrUplink:
    """Carries packets on a carrier of the settings, in slots of τ_o seconds of the loops.

    Raises:
        UsageError: a carrier that the standard does not have, an MCS without error rates.
            Or Sionna is not installed.
    """

    def __init__(self, radio: RadioSettings, nr: NrSettings, slot_s: float) -> None:
        check(radio, nr)
        self._nr, self._slot_s = nr, slot_s
        self.carrier = Carrier(nr.spacing_khz, radio.bandwidth_hz, nr.duplex)
        self.overhead_bits = nr.header_bits
        self._errors = errors = block_errors.block_errors(nr.mcs_table)
        self.dmrs_elements = dmrs_elements(nr.pusch_symbols, nr.dmrs_additional)
        elements = data_elements_per_prb(nr.pusch_symbols, self.dmrs_elements)
        self._prbs = allowed_prbs(self.carrier.prbs)
        grid = errors.modulation_order[:, None], errors.code_rate[:, None]
        self._blocks = transport_block(self._prbs, elements, *grid)  # [M, P]
        self._rows = np.arange(len(errors.mcs))[:, None]
        self._permitted = np.ones(len(errors.mcs), dtype=bool)
        if nr.mcs >= 0:
            self._permitted = errors.mcs == nr.mcs
        # Slots of the carrier in one of the loop, and those in which the uplink is on.
        self._slots = slot_s / self.carrier.slot_s
        self._uplink_slots = self._slots * self.carrier.uplink_share
        self._aged_db = np.zeros(1)
        if nr.cqi_age_slots > 0:
            age_s = nr.cqi_age_slots * self.carrier.slot_s
            correlation = power_correlation(doppler_hz(radio.speed_m_s, radio.carrier_ghz), age_s)
            self._aged_db = aged_offsets_db(correlation)

    @functools.lru_cache(maxsize=4096)  # noqa: B019 - a handful of layers, asked again and again
    def carries(
        self, payload_bits: float, snr_db: float, *, dynamic: bool | None = None
    ) -> Carried:
        """Return what slots carry: the allocation that takes least of them per packet delivered."""
        check_snr(snr_db)
        if dynamic is None:
            dynamic = self._nr.grants == "dynamic"
        found = self._adapted(payload_bits, snr_db)
        if found is None:
            return Carried(
                packets_per_slot=0.0,
                transmissions_per_slot=0.0,
                resource_transmissions=0.0,
                allocation_hz=self.carrier.prbs * self.carrier.prb_hz,
                described=self._why_nothing(snr_db),
            )
        side, room = self._packed(found.prbs)
        room /= found.segments
        sent = room
        if dynamic:
            downlink = 1.0 if self._nr.duplex == "FDD" else 1.0 - self.carrier.uplink_share
            grants = self._nr.grants_per_slot * self._slots * downlink
            sent = min(room, grants / found.segments)
        rounds = 1.0 - (1.0 - found.left) ** found.segments  # of the whole packet
        before = np.concatenate([[1.0], found.left[:-1]])
        delivered, transmissions = 1.0 - rounds[-1], before.sum()
        trip_s = self._round_trip_slots * self.carrier.slot_s
        latency_s = 2 * self.carrier.processing_s + self._duration_s(found, side)
        conditional = rounds / np.concatenate([[1.0], rounds[:-1]]).clip(np.finfo(float).tiny)
        row, errors = found.row, self._errors
        c = sent * delivered / transmissions
        return Carried(
            packets_per_slot=c,
            transmissions_per_slot=sent,
            resource_transmissions=room,
            round_errors=tuple(np.minimum(conditional, 1.0).tolist()),
            latency_s=latency_s,
            late_slots=self._late_slots(latency_s, trip_s, rounds),
            round_trip_slots=max(1, math.ceil(trip_s / self._slot_s * (1 - ROUNDING))),
            allocation_hz=found.prbs * self.carrier.prb_hz,
            details={
                "mcs": int(errors.mcs[row]),
                "modulation_order": int(errors.modulation_order[row]),
                "code_rate": float(errors.code_rate[row]),
                "prbs": found.prbs,
                "data_symbols": self._nr.pusch_symbols,
                "dmrs_re_per_prb": self.dmrs_elements,
                "tbs_bits": int(found.block.bits),
                "segments": found.segments,
                "bler": float(found.left[0]),
                "bler_is_bound": bool(errors.is_bound(found.block.code_block_bits, snr_db)),
                "grants": "dynamic" if dynamic else "configured",
                "packets_per_slot": c,
                "latency_s": latency_s,
            },
            described=f"a packet takes {1 / room:.3g} slots" if room else "no packet fits",
        )

    def shared_by(self, delivery: float, payload_bits: float, snr_db: float, noise: Noise) -> int:
        """Return the most devices, all with one allocation per slot of the loop, that get through.

        They are dealt out to the carrier's slots and to the places in time within one, and share
        the PRBs equally; each takes the lowest code rate at which a packet fits its part.
        """
        check_snr(snr_db)
        places = math.floor(self._uplink_slots * self._per_slot * (1 + ROUNDING))
        few, many = 0, places * self.carrier.prbs
        while few < many:
            middle = (few + many + 1) // 2
            part = self.carrier.prbs // math.ceil(middle / max(places, 1))
            if self._delivery(part, payload_bits, snr_db, noise) >= delivery:
                few = middle
            else:
                many = middle - 1
        return few

    def delivery_alone(self, payload_bits: float, snr_db: float) -> float:
        """Return the probability of a device on all PRBs of one carrier's slot."""
        return self._delivery(self.carrier.prbs, payload_bits, snr_db, "fixed")

    @functools.lru_cache(maxsize=4096)  # noqa: B019 - as above
    def reports(self, devices: int, snr_db: float) -> Reports:
        """Return what innovation reports take.

        ``sr``: each device has a place for a scheduling request every 8 slots of the loop, one
        cyclic shift of PUCCH format 0. ``pucch``: a place for two bits, which take four shifts.
        ``grant``: one small configured grant for all, as many as a slotted ALOHA channel needs.
        ``free``: 8 bits that take nothing.
        """
        delay_s = 2 * self.carrier.processing_s + self.carrier.slot_s / self.carrier.uplink_share
        delay = math.ceil(delay_s / self._slot_s * (1 - ROUNDING))
        symbols = self._uplink_slots * SLOT_SYMBOLS * self.carrier.prbs  # of one PRB, in a slot
        kind = self._nr.reports
        if kind == "free":
            return Reports(GRANT_BITS)
        if kind == "grant":
            bits = GRANT_BITS + GRANT_HEADER_BITS + math.ceil(math.log2(max(devices, 1)))
            return Reports(bits, CONTENTION * self._small_grant(bits, snr_db), 0.0, 0, delay)
        bits = 1 if kind == "sr" else PUCCH_BITS
        shifts = 1 if kind == "sr" else 2**PUCCH_BITS
        asking = devices / REPORT_PERIOD * shifts / PUCCH_SHIFTS * PUCCH_SYMBOLS
        return Reports(bits, 0.0, min(asking / symbols, 1.0), shifts, delay)

    @property
    def _per_slot(self) -> int:
        """Return how many PUSCH follow each other in a slot."""
        return SLOT_SYMBOLS // self._nr.pusch_symbols

    @property
    def _round_trip_slots(self) -> float:
        """Return slots from a transmission to its repetition, in the next uplink slot."""
        wait, pattern = self._nr.harq_rtt_slots, self._nr.duplex
        if pattern == "FDD":
            return wait
        uplink = [slot for slot, kind in enumerate(pattern) if kind == "U"]
        waits = [_next_uplink(pattern, slot + wait) - slot for slot in uplink]
        return float(np.mean(waits))

    def _packed(self, prbs: int) -> tuple[int, float]:
        """Return how many allocations lie side by side, and how many a slot of the loop has."""
        side = self.carrier.prbs // prbs
        return side, self._uplink_slots * self._per_slot * side

    def _duration_s(self, found: Allocation, side: int) -> float:
        """Return how long a packet is on the air: its blocks follow each other."""
        rows = math.ceil(found.segments / side)  # places in time
        slots = math.ceil(rows / self._per_slot)
        last = rows - (slots - 1) * self._per_slot
        waits_s = (slots - 1) * self.carrier.slot_s / self.carrier.uplink_share
        return waits_s + self.carrier.seconds(last * self._nr.pusch_symbols)

    def _late_slots(self, latency_s: float, trip_s: float, rounds: Floats) -> float:
        """Return the mean lateness of what gets through, in slots of the loop.

        A packet whose copies are all lost is replaced by a new sample a round trip later: its gap
        is that much longer.
        """
        reached = np.concatenate([[1.0], rounds[:-1]]) - rounds
        late = (latency_s + trip_s * np.arange(len(rounds))) / self._slot_s
        late = np.where(late > 1 + ROUNDING, late, 0.0)
        lost = float(rounds[-1])
        if lost == 1.0:
            return math.inf
        replaced = lost / (1 - lost) * len(rounds) * trip_s / self._slot_s
        return float(reached @ late / reached.sum() + replaced)

    def _adapted(self, payload_bits: float, snr_db: float) -> Allocation | None:
        """Return the allocation for a packet; ``None`` where no MCS keeps the target."""
        left = self._left(snr_db)  # [rounds, M, P]
        target = self._nr.bler_target * (1 + ROUNDING)
        outer = self._nr.link_adaptation == "outer"
        held = left[0] if outer else self._block_errors(snr_db, np.zeros(1))
        usable = self._permitted[:, None] & (held <= target)
        if self._nr.mcs >= 0:  # not adapted: whatever gets lost
            usable = self._permitted[:, None] & (left[-1] < 1.0)
        room = np.where(usable, self._blocks.bits, 0)
        most = int(room.max()) - self.overhead_bits
        if most <= 0:
            return None
        fewest = math.ceil(payload_bits / most)
        best: tuple[float, float] | None = None
        chosen: Allocation | None = None
        for segments in range(fewest, 2 * fewest):
            fits = room >= math.ceil(payload_bits / segments) + self.overhead_bits
            before = np.concatenate([np.ones_like(left[:1]), left[:-1]]).sum(axis=0)
            delivered = np.maximum((1.0 - left[-1]) ** segments, NEVER)
            side = self.carrier.prbs // self._prbs  # allocations so wide in a slot
            cost = np.where(fits, segments / side * before / delivered, np.inf)
            least = cost.min()
            even = cost <= least * (1 + ROUNDING)
            risk = np.where(even, left[0], np.inf)
            if best is None or (least, risk.min()) < best:
                row, column = np.unravel_index(int(risk.argmin()), risk.shape)
                best = least, float(risk.min())
                block = TransportBlock(*(of[row, column] for of in self._blocks))
                width = int(self._prbs[column])
                chosen = Allocation(int(row), width, block, segments, left[:, row, column])
        return chosen

    @functools.lru_cache(maxsize=1024)  # noqa: B019 - as above
    def _left(self, snr_db: float) -> Floats:
        """Return what is lost after one, two, … transmissions of each MCS and width [rounds, M, P].

        The receiver adds the SNRs of copies (chase combining).
        """
        copies = 10.0 * np.log10(np.arange(1, self._nr.harq_rounds + 1))
        errors = [self._block_errors(snr_db + gain_db, self._aged_db) for gain_db in copies]
        return np.asarray(np.minimum.accumulate(np.stack(errors)))

    def _block_errors(self, snr_db: float, offsets_db: Floats) -> Floats:
        """Return the mean transport block error of each MCS and width over SNRs around one [M, P].

        The offsets are equally likely.
        """
        size, count = self._blocks.code_block_bits, self._blocks.code_blocks
        total = np.zeros(size.shape)
        for some_db in _chunks(offsets_db):
            rates = self._errors.transport_rate(
                self._rows[..., None], size[..., None], count[..., None], snr_db + some_db
            )
            total += rates.sum(axis=-1)
        return total / len(offsets_db)

    def _delivery(self, prbs: int, payload_bits: float, snr_db: float, noise: Noise) -> float:
        """Return the share of packets that get through on so many PRBs under Rayleigh fading."""
        widths = self._prbs[self._prbs <= prbs]
        if not len(widths):
            return 0.0
        column, bits = len(widths) - 1, payload_bits + self.overhead_bits
        fits = self._permitted & (self._blocks.bits[:, column] >= bits)
        if not fits.any():
            return 0.0
        rows = np.flatnonzero(fits)
        gains = -np.log1p(-(np.arange(FADES) + 0.5) / FADES)
        boost = self.carrier.prbs / int(widths[-1]) if noise == "scaled" else 1.0
        faded_db = snr_db + 10 * np.log10(gains * boost)
        size, count = (of[rows, column, None] for of in self._blocks[1:])
        lost = self._errors.transport_rate(rows[:, None], size, count, faded_db).mean(axis=1)
        return float(1.0 - lost.min())

    def _small_grant(self, bits: int, snr_db: float) -> float:
        """Return the share of a slot of the loop that a report of so many bits takes."""
        elements = data_elements_per_prb(GRANT_SYMBOLS, dmrs_elements(GRANT_SYMBOLS, 0))
        errors = self._errors
        blocks = transport_block(
            self._prbs, elements, errors.modulation_order[:, None], errors.code_rate[:, None]
        )
        lost = errors.transport_rate(self._rows, blocks.code_block_bits, blocks.code_blocks, snr_db)
        fits = (blocks.bits >= bits) & (lost <= self._nr.bler_target)
        if not fits.any():
            return 1.0
        prbs = int(np.broadcast_to(self._prbs, fits.shape)[fits].min())
        places = self._uplink_slots * (SLOT_SYMBOLS // GRANT_SYMBOLS)
        return float(1.0 / (places * (self.carrier.prbs // prbs)))

    def _why_nothing(self, snr_db: float) -> str:
        lowest = int(self._errors.mcs[self._permitted][0])
        if self._nr.mcs >= 0:
            return f"at {snr_db:g} dB every block of MCS {lowest} is lost"
        return (
            f"at {snr_db:g} dB not even MCS {lowest} of table {self._nr.mcs_table} keeps a block "
            f"error rate of {self._nr.bler_target:g}"
        )


def dmrs_elements(symbols: int, additional: int) -> int:
    """Return the resource elements of a PRB that reference signals take (TS 38.211, 6.4.1.1.3).

    Mapping type B, single symbols: as many additional positions as are asked for and as the length
    allows; no data between them (two CDM groups without data), so that each takes 12.
    """
    allowed = 0 if symbols < 5 else 1 if symbols < 8 else 2 if symbols < 10 else 3
    return SUBCARRIERS * (1 + min(additional, allowed))


def allowed_prbs(most: int) -> Integers:
    """Return the widths that transform precoding allows: 2^a 3^b 5^c (TS 38.211, 6.3.1.4)."""
    widths = []
    for width in range(1, most + 1):
        rest = width
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            widths.append(width)
    return np.array(widths)


def aged_offsets_db(correlation: float) -> Floats:
    """Return equally likely SNR offsets where power control follows a fade that was seen earlier.

    The gains |h|² then and now are Rayleigh with a correlation ρ² of powers: power control makes up
    for the one, and the SNR is off by the ratio. Given the old gain g the new one is noncentral
    chi-square: (1 − ρ²)/2 times one of 2 degrees of freedom around 2 ρ² g / (1 − ρ²).
    """
    from scipy.stats import ncx2

    shares = (np.arange(QUANTILES) + 0.5) / QUANTILES
    then = -np.log1p(-shares)
    spread = max(1.0 - correlation, 1e-9)
    around = 2 * correlation * then[:, None] / spread
    now = spread / 2 * ncx2.ppf(shares, 2, around)
    return np.asarray(10 * np.log10(np.maximum(now, 1e-12) / then[:, None]).ravel())


def check_snr(snr_db: float) -> None:
    """Raise UsageError for an SNR outside of Sionna's tables."""
    low, high = block_errors.SNR_DB
    if not low <= snr_db <= high:
        raise UsageError(
            f"--snr {snr_db:g}: the block error tables of --phy nr reach from {low:g} to "
            f"{high:g} dB",
            hint="hjepa scale --phy nr --snr 10:30",
        )


def check(radio: RadioSettings, nr: NrSettings) -> None:
    """Raise UsageError for settings that no NR cell has, and without Sionna."""
    Carrier(nr.spacing_khz, radio.bandwidth_hz, nr.duplex)
    lowest = block_errors.LOWEST_MCS[nr.mcs_table]
    if 0 <= nr.mcs < lowest:
        raise UsageError(
            f"--mcs {nr.mcs}: table {nr.mcs_table} has simulated error rates for MCS {lowest} to "
            "27; or -1, which adapts it"
        )
    if nr.cqi_age_slots > 0 and radio.fading == "block":
        raise UsageError(
            f"--cqi-age-slots {nr.cqi_age_slots:g}: a fade of --fading block has no age",
            hint="add --fading jakes --speed-m-s 1, or leave out --cqi-age-slots",
        )
    for snr_db in parse_snr(radio.snr_db):
        check_snr(snr_db)
    block_errors.check_installed()


def _next_uplink(pattern: str, slot: int) -> int:
    """Return the first uplink slot from one on."""
    while pattern[slot % len(pattern)] != "U":
        slot += 1
    return slot


def _chunks(values: Floats, length: int = 256) -> Iterator[Floats]:
    return (values[start : start + length] for start in range(0, len(values), length))


NR = Phy(
    name="nr",
    help="a 5G NR uplink",
    layer=NrUplink,
    uses=tuple(f"nr.{field.name}" for field in dataclasses.fields(NrSettings)),
    check=check,
)
