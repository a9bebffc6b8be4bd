"""The shared uplink says who may send in each slot, and what the base station knows.

J resource blocks a slot, each one transmission long. Power control holds every transmission at the
target SNR; a device in a fade deeper than its power margin cannot send at all.
"""

import dataclasses
import math
from collections import deque

import numpy as np

from hjepa_cli.compute.seeding import generator
from hjepa_cli.core.arrays import Bools, Floats
from hjepa_cli.core.control.disagreement import LevelDisagreement
from hjepa_cli.core.control.error_growth import ErrorGrowthTable
from hjepa_cli.core.plants.guarded import guarded
from hjepa_cli.core.radio.doppler import Motion, moving_fading
from hjepa_cli.core.radio.fading import block_fading
from hjepa_cli.core.radio.phy.phy import Reports
from hjepa_cli.core.radio.phy.shannon import INNOVATION_BITS
from hjepa_cli.core.radio.schedulers.scheduler import SlotView, pick
from hjepa_cli.errors import UsageError
from hjepa_cli.plugins import SCHEDULERS

EIGHT_BITS = Reports(INNOVATION_BITS)
CHECK_PERIOD = 8  # slots between a device's looks at its own camera, staggered over devices
REPORT_AGAIN = 2.0  # times the last report: an innovation is reported once, and when it doubles
REPORTS_PER_BLOCK = 1.0  # that δ is steered to: a candidate for every transmission
STEERING = 0.02  # of ln δ per slot and excess report
_ERRORS_KEY = 0xE5
DELTA = (1e-3, 0.5)  # range of δ, in parts of the force range


@dataclasses.dataclass(frozen=True)
class Access:
    """Holds the rules by which devices share blocks.

    Attributes:
        scheduler: its name.
        blocks: J, transmissions per slot.
        margin_db: G, of each device or all: fades deeper than this block a device; ∞ blocks nobody.
        k_factor_db: Rician K, likewise; −∞ is Rayleigh.
        coherence_slots: mean slots a fade lasts.
        round_errors: share of transmissions that fail although the power sufficed: of first copies
            of a sample, of second ones (the copies combined), … One entry: none is repeated.
        growth: of the control error with age, measured for the controller.
        seed: of the fading.
        levels: scales the growth by the disagreement of a controller's two levels, if it has them.
        round_trip_slots: from one copy of a sample to the next, at least.
        reports: what innovations are reported with.
        motion: of the devices; without one fades last ``coherence_slots``.
    """

    scheduler: str
    blocks: int
    margin_db: float | Floats
    k_factor_db: float | Floats
    coherence_slots: float
    round_errors: tuple[float, ...]
    growth: ErrorGrowthTable
    seed: int
    levels: LevelDisagreement | None = None
    round_trip_slots: int = 1
    reports: Reports = EIGHT_BITS
    motion: Motion | None = None


class Uplink:
    """Keeps the state of N devices; in each slot :meth:`begin`, maybe :meth:`hear`, then grant.

    Raises:
        UsageError: unknown scheduler, or more blocks than devices.
    """

    def __init__(self, access: Access, devices: int) -> None:
        scheduler = SCHEDULERS[access.scheduler]
        if not 1 <= access.blocks <= devices:
            raise UsageError(
                f"{access.blocks} resource blocks for {devices} devices; use 1 to {devices}"
            )
        self._access = access
        self._score = guarded(SCHEDULERS, access.scheduler, scheduler.score)
        self.listens = scheduler.wants_reports
        k_factor_db = access.k_factor_db
        self._fading = (
            moving_fading(access.seed, devices, access.motion, k_factor_db=k_factor_db)
            if access.motion
            else block_fading(
                access.seed,
                devices,
                k_factor_db=k_factor_db,
                coherence_slots=access.coherence_slots,
            )
        )
        self._errors = generator(access.seed, _ERRORS_KEY)
        self._round_errors = np.array(access.round_errors)
        margin_db = np.broadcast_to(np.asarray(access.margin_db, np.float64), devices)
        self._threshold = 10.0 ** (-margin_db / 10.0)
        self._fair_age = devices / access.blocks
        self._slot = 0
        self._delta = 0.02
        # Beyond the last entry of the growth table nobody would look, and δ never fall again.
        self._highest_delta = float(np.clip(math.sqrt(access.growth.table[-1]), *DELTA))
        self._gain = np.ones(devices)
        self._age = np.ones(devices, dtype=np.int64)
        # Before the first slot, device 0 has waited longest.
        self._waited = np.arange(devices, 0, -1)
        self._queue = np.zeros(devices)
        self._reported = np.zeros(devices)
        # What the base station knows of it: reports take a while.
        self._on_their_way = deque([np.zeros(devices)], maxlen=access.reports.delay_slots + 1)
        self._uncertainty = np.ones(devices)
        # Copies that were lost of the sample a device is repeating, and slots since it was taken.
        self._lost = np.zeros(devices, dtype=np.int64)
        self._behind = np.zeros(devices, dtype=np.int64)
        self.sampled = np.zeros(devices, dtype=bool)
        self.reports = 0

    def begin(self) -> None:
        """Start a slot with new fading."""
        self._gain = next(self._fading)

    def weigh(self, apart: Floats) -> None:
        """Take the disagreement of each controller's levels [N]."""
        if self._access.levels:
            self._uncertainty = self._access.levels.relative_growth(self._age, apart)

    def checking(self) -> Bools:
        """Choose the devices that compare the controller's force with their own now [N].

        It is their turn, they could report, and their error may well be beyond δ.
        """
        turn = (self._slot + np.arange(len(self._gain))) % CHECK_PERIOD == 0
        if not self._slot:
            return np.zeros_like(turn)
        due = self._access.growth.at(self._age) * self._uncertainty >= self._delta**2
        return np.asarray(turn & self._able & due)

    def hear(self, devices: Bools, innovation: Floats) -> None:
        """Take the innovations |C(z) − ũ| ÷ the force range of ``devices``; some report."""
        sent = self._told(innovation)
        reports = innovation >= self._delta
        reports &= sent >= REPORT_AGAIN * self._reported[devices]
        who = np.flatnonzero(devices)[reports]
        self._reported[who] = sent[reports]
        self.reports += len(who)
        # The other devices look in other slots: this slot's reports are its share of all.
        excess = len(who) / self._access.blocks - REPORTS_PER_BLOCK
        steered = self._delta * math.exp(STEERING * excess)
        self._delta = min(max(steered, DELTA[0]), self._highest_delta)

    def grant(self) -> Bools:
        """Hand out the blocks of this slot and end it; return whose packets arrive [N].

        In the very first slot everybody's does: loops start with a known state.
        """
        self._on_their_way.append(self._reported.copy())
        view = SlotView(
            age=self._age,
            waited=self._waited,
            gain=self._gain,
            power=self._power,
            queue=self._queue,
            reported=self._on_their_way[0],
            growth=self._access.growth,
            uncertainty=self._uncertainty,
        )
        trips = self._lost * self._access.round_trip_slots
        repeats = (self._lost > 0) & self._able  # a copy that waits is worth less every slot
        scores = np.where(repeats, np.inf, self._checked(self._score(view)))
        scores = np.where(self._behind < trips, 0.0, scores)  # the base station has yet to answer
        chosen = pick(scores, self._access.blocks)
        sent = chosen & self._able if self._slot else np.ones_like(chosen)
        failed = self._errors.random(len(chosen)) < self._round_errors[self._lost]
        arrived = sent & ~failed if self._slot else sent
        rounds = len(self._round_errors)
        self.sampled = sent & (self._lost == 0) & (arrived | (rounds > 1))
        copies = np.where(sent & ~arrived, self._lost + 1, self._lost)
        self._lost = np.where(arrived | (copies == rounds), 0, copies)  # who will repeat a sample
        self._waited = np.where(chosen, 0, self._waited) + 1
        self._queue = np.maximum(self._queue - self._fair_age, 0.0) + self._age
        self._age = np.where(arrived, self._behind, self._age) + 1
        self._behind = np.where(self._lost > 0, self._behind + 1, 0)
        self._reported[arrived] = 0.0
        for told in self._on_their_way:  # a report of before the packet says nothing any more
            told[arrived] = 0.0
        self._slot += 1
        return arrived

    def _told(self, innovation: Floats) -> Floats:
        """Return the innovations as reports say them: in 8 bits, or in a few levels from δ on."""
        if levels := self._access.reports.levels:
            with np.errstate(divide="ignore"):
                level = np.floor(np.log2(innovation / self._delta))
            return np.asarray(self._delta * 2.0 ** (np.clip(level, 0, levels - 1) + 0.5))
        steps = 2**INNOVATION_BITS
        return np.asarray((np.minimum(np.floor(innovation * steps), steps - 1) + 0.5) / steps)

    def _checked(self, scores: object) -> Floats:
        """Return scores; raise UsageError where they are none. It costs little beside a slot."""
        found = np.asarray(scores)
        if found.shape != self._gain.shape or found.dtype.kind not in "fiub":
            shown = f"{np.shape(found)} of {found.dtype}"
        elif math.isnan(found.max()):
            shown = f"NaN for device {int(np.isnan(found).argmax())}"
        else:
            return found
        name = self._access.scheduler
        wanted = f"expected numbers of shape {self._gain.shape}"
        raise SCHEDULERS.fault(name, f"scheduler '{name}': score(…) is {shown}; {wanted}")

    @property
    def _power(self) -> Floats:
        """Return the power that the target takes ÷ the power limit [N]."""
        with np.errstate(divide="ignore"):
            return np.asarray(self._threshold / self._gain)

    @property
    def _able(self) -> Bools:
        return np.asarray(self._power <= 1.0)  # as schedulers see it: up to rounding, gain ≥ margin
