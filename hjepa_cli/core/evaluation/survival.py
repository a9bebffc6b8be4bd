"""A loop goes on for a while without expected packets: how long, and how often it then is lost.

From steady operation with a packet every I steps, one gap of g steps between two packets, then
packets every I steps again. A loop is lost that leaves the region from which it recovers, which is
where the plant's stage cost stays below its cap. Survival time is TS 22.104's: how long an
application goes on without an anticipated message, here g − I.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import special

from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.schema import ProtocolSettings
from hjepa_cli.core.arrays import Bools, Floats, Integers
from hjepa_cli.core.control.loop import Draws, noise_per_step, simulate
from hjepa_cli.core.evaluation.simulator import Simulator, Tick
from hjepa_cli.core.plants.cost import COST_CAP
from hjepa_cli.core.plants.system import System

LEVELS = (1e-1, 1e-2, 1e-3)  # of losses that are counted
RARE = 1e-4  # comes from splitting
_SPLITTING_KEY = 0x5117
KEPT_SHARE = 0.2  # of the paths at each level of splitting
MOST_SPLITS = 10  # levels; KEPT_SHARE ** 10 is 1e-7
MOVES, FIRST_STRIDE, TAKEN_SHARE = 3, 0.5, 0.35  # of all paths at each level


@dataclasses.dataclass(frozen=True)
class Trial:
    """Describes one gap in the packets of loops: when what happens, in steps.

    Attributes:
        interval_steps: I.
        settle_steps: with packets, before the last one in time arrives.
        watch_steps: with packets again, until a loop counts as not back.
    """

    interval_steps: int
    settle_steps: int
    watch_steps: int

    @classmethod
    def of(cls, protocol: ProtocolSettings, interval_steps: int) -> "Trial":
        """Return that of a protocol, whose warm-up is long for a loop of its plant."""
        long = max(protocol.warmup_steps, 1)
        return cls(interval_steps, max(long // 2, interval_steps), long)

    def steps(self, gap_steps: int) -> int:
        """Return how long a trial takes."""
        return self.settle_steps + gap_steps + self.watch_steps

    def schedule(self, gap_steps: int, steps: int, devices: int) -> Bools:
        """Return when packets are sent: bool [steps, devices], the same for all devices.

        They arrive in the same step where the link is never late.
        """
        k = np.arange(steps)
        last = self.settle_steps
        before = (k <= last) & ((last - k) % self.interval_steps == 0)
        after = (k >= last + gap_steps) & ((k - last - gap_steps) % self.interval_steps == 0)
        times = before | after
        times[0] = True
        return np.repeat(times[:, None], devices, axis=1)


@dataclasses.dataclass(frozen=True)
class Silences:
    """Holds what came of gaps [P] in the packets of loops [N].

    Attributes:
        lost: whether each left the region from which it recovers, during or after its gap [P, N].
        left_band: whether it left the band during its gap [P, N].
        back_steps: from the packet that ends the gap until it is in the band; ∞ where it is not
            within the time that it is watched [P, N].
    """

    lost: Bools
    left_band: Bools
    back_steps: Floats

    @classmethod
    def joined(cls, parts: Sequence["Silences"]) -> "Silences":
        """Join those of different loops."""
        names = [field.name for field in dataclasses.fields(cls)]
        return cls(*(np.concatenate([getattr(one, name) for one in parts], 1) for name in names))


class Watch:
    """Looks at loops [P, N] step by step; what it keeps is as of :class:`Silences`."""

    def __init__(self, plant: System, trial: Trial, gaps: Sequence[int], devices: int) -> None:
        self._plant, self._trial = plant, trial
        self._gaps, shape = np.array(gaps)[:, None], (len(gaps), devices)
        self.lost, self.left_band = np.zeros(shape, bool), np.zeros(shape, bool)
        self.back_steps = np.full(shape, np.inf)

    def __call__(self, k: int, states: Floats, forces_n: Floats) -> None:
        since = k - self._trial.settle_steps
        if since <= 0:
            return
        inside = np.asarray(self._plant.in_band(states)).reshape(self.lost.shape)
        ended = since >= self._gaps
        self.left_band |= ~inside & ~ended
        arrived = ended & inside & np.isinf(self.back_steps)
        self.back_steps = np.where(arrived, since - self._gaps, self.back_steps)
        within = since <= self._gaps + self._trial.watch_steps
        self.lost |= within & (danger(self._plant, states).reshape(self.lost.shape) >= 1.0)


def danger(plant: System, states: Floats) -> Floats:
    """Return how near states [n, S] are to being lost: their stage cost ÷ its cap; 1 is lost."""
    return np.asarray(plant.cost(states, plant.no_force(len(states)))) / COST_CAP


@dataclasses.dataclass(frozen=True)
class Gaps:
    """Is a unit: loops ``start`` … ``stop`` − 1 of a method, each through every gap.

    Equal loops meet the same starts and gusts, whatever the gap and the method.
    """

    method: str
    trial: Trial
    gaps: tuple[int, ...]
    start: int
    stop: int

    def compute(self, simulator: Simulator, tick: Tick) -> Silences:
        """Simulate them."""
        steps = self.trial.steps(max(self.gaps))
        devices = self.stop - self.start
        draws = _draws(simulator, steps, self.stop).part(slice(self.start, self.stop))
        watch = Watch(simulator.plant, self.trial, self.gaps, devices)
        schedules = [self.trial.schedule(gap, steps, devices) for gap in self.gaps]
        _drive(simulator, self.method, draws, np.stack(schedules), watch, tick)
        back = np.where(watch.lost, np.inf, watch.back_steps)
        return Silences(watch.lost, watch.left_band, back)


@dataclasses.dataclass(frozen=True)
class Rare:
    """Is a unit: the probability that a loop is lost in one gap, by splitting."""

    method: str
    trial: Trial
    gap: int
    paths: int

    def compute(self, simulator: Simulator, tick: Tick) -> tuple[float, float]:
        """Return the probability, and the standard deviation of its logarithm."""
        steps = self.trial.steps(self.gap)
        first = _draws(simulator, steps, self.paths)
        scale = noise_per_step(simulator.settings.protocol)
        random = generator(simulator.settings.seed, _SPLITTING_KEY, self.gap)
        schedule = self.trial.schedule(self.gap, steps, self.paths)[None]

        def run(normal: Floats, rows: Integers) -> Floats:
            noise = normal * scale
            draws = Draws(
                first.initial[rows],
                noise,
                np.zeros(noise.shape[:2]),
                first.mass_scale[rows],
                link=first.link.part(rows),
            )
            peak = np.zeros(len(rows))

            def watch(k: int, states: Floats, forces_n: Floats) -> None:
                if k > self.trial.settle_steps:
                    np.maximum(peak, danger(simulator.plant, states), out=peak)

            _drive(simulator, self.method, draws, schedule[..., : len(rows)], watch, tick)
            return peak

        # Only what disturbs a state: the noise of others is none, whatever is drawn.
        normal = np.divide(first.noise, scale, out=np.zeros_like(first.noise), where=scale > 0)
        return splitting(run, normal, random)


def splitting(
    run: Callable[[Floats, Integers], Floats], normal: Floats, random: np.random.Generator
) -> tuple[float, float]:
    """Return the probability that a path comes to 1, by splitting in levels.

    Paths are functions of normal noise. The fifth that comes nearest is kept; each of the others
    becomes a copy of one of them, and all move on: noise √(1 − β²) z + β ξ is taken where the path
    stays beyond the level. The probability is the product of the shares kept, until a fifth comes
    to 1 (subset simulation, Au and Beck, Probabilistic Engineering Mechanics 16, 2001). All of the
    noise moves, since what is lost in the end was often begun long before it could be seen.

    Args:
        run: how near to 1 paths come at most [m], under their noise [T, m, ...]; ``rows`` [m] says
            which of the first paths they descend from, for what else differs between them.
        normal: standard normal noise of the first paths [T, n, ...].
        random: draws copies and moves.

    Returns:
        The probability, 0 where paths come no further, and about the standard deviation of its
        logarithm: 1.5 times that of independent paths, √(Σ (1 − p)/(p n)) over the levels, which
        copies are not; ∞ where it is 0.
    """
    normal, count = normal.copy(), normal.shape[1]
    rows = np.arange(count)
    peak, stride = run(normal, rows), FIRST_STRIDE
    probability, variance = 1.0, 0.0
    for _ in range(MOST_SPLITS):
        level = min(float(np.quantile(peak, 1 - KEPT_SHARE, method="lower")), 1.0)
        kept = peak >= 1.0 if level >= 1.0 else peak > level
        share = float(kept.mean())
        if share == 0.0:
            break
        probability, variance = probability * share, variance + (1 - share) / (share * count)
        if level >= 1.0:
            return probability, 1.5 * math.sqrt(variance)
        killed = np.flatnonzero(~kept)
        parents = random.choice(np.flatnonzero(kept), size=len(killed))
        normal[:, killed], peak[killed] = normal[:, parents], peak[parents]
        rows[killed] = rows[parents]
        for _ in range(MOVES):
            step = random.standard_normal(normal.shape)
            moved = math.sqrt(1 - stride**2) * normal + stride * step
            reached = run(moved, rows)
            taken = reached > level
            normal[:, taken], peak[taken] = moved[:, taken], reached[taken]
            stride = float(np.clip(stride * math.exp(taken.mean() - TAKEN_SHARE), 0.05, 0.95))
    return 0.0, math.inf


def clopper_pearson(events: npt.ArrayLike, trials: npt.ArrayLike) -> tuple[Floats, Floats]:
    """Return the exact two-sided 95 % interval of a probability (Clopper and Pearson, 1934)."""
    k, n = np.asarray(events, np.float64), np.asarray(trials, np.float64)
    with np.errstate(invalid="ignore"):
        low = np.where(k > 0, special.betaincinv(np.maximum(k, 1e-9), n - k + 1, 0.025), 0.0)
        high = np.where(k < n, special.betaincinv(k + 1, np.maximum(n - k, 1e-9), 0.975), 1.0)
    return low, high


@dataclasses.dataclass(frozen=True)
class LossCurve:
    """Holds the probabilities that loops are lost in gaps, as counted.

    Attributes:
        gaps: ascending [P], in steps.
        lost, loops: counts [P].
    """

    gaps: Integers
    lost: Integers
    loops: Integers

    @property
    def probability(self) -> Floats:
        """Return probabilities that ascend with the gap: counts of neighbours pooled where not."""
        shares, weights = list[float](), list[float]()
        sizes = list[int]()
        for k, n in zip(self.lost.tolist(), self.loops.tolist(), strict=True):
            shares.append(k / n)
            weights.append(n)
            sizes.append(1)
            while len(shares) > 1 and shares[-2] > shares[-1]:
                share, weight, size = shares.pop(), weights.pop(), sizes.pop()
                total = weights[-1] + weight
                shares[-1] = (shares[-1] * weights[-1] + share * weight) / total
                weights[-1], sizes[-1] = total, sizes[-1] + size
        return np.repeat(shares, sizes)

    def tolerated(self, level: float) -> tuple[int, tuple[int, int | None], bool]:
        """Return the longest gap in which at most a share of the loops is lost.

        Returns:
            The gap, 0 where there is none; the ends of its 95 % interval: the longest up to which
            upper Clopper-Pearson bounds stay below the level, and the first at which a lower one is
            above it, ``None`` where none is; and whether loops are still there at the longest gap.
        """
        low, high = clopper_pearson(self.lost, self.loops)
        held = self.probability <= level
        surely = np.logical_and.accumulate(high <= level)
        beyond = np.flatnonzero(low > level)
        gap = int(self.gaps[held].max(initial=0))
        least = int(self.gaps[surely].max(initial=0))
        most = int(self.gaps[beyond[0]]) if len(beyond) else None
        return gap, (min(least, gap), most if most is None else max(most, gap)), bool(held.all())

    def wanted(self, levels: Sequence[float], width: float) -> list[int]:
        """Return gaps that would say more: in the middle of brackets that are too wide."""
        found = set[int]()
        probability = self.probability
        for level in levels:
            left = int((probability <= level).sum()) - 1
            if left < 0 or left + 1 == len(self.gaps):
                continue
            a, b = int(self.gaps[left]), int(self.gaps[left + 1])
            middle = round(math.sqrt(a * b))
            if b > a * width and a < middle < b:
                found.add(middle)
        return sorted(found)


def loss_of_gap(curve: LossCurve, rare: Sequence[tuple[int, float]]) -> Callable[[Floats], Floats]:
    """Return the probability that a loop is lost in a gap, of any length.

    Between what was counted, and found by splitting, the logarithm is linear. The longest gap in
    which none of n loops was lost counts with 3/n, the upper end of its 95 % interval, where
    nothing else is known below the others. Below, the line through the two shortest goes on: losses
    are rarer there still, since their logarithm falls ever faster, so that it is a bound; above,
    every loop is lost.
    """
    known = dict(zip(curve.gaps.tolist(), curve.probability.tolist(), strict=True))
    known |= {gap: p for gap, p in rare if p > 0 and known.get(gap, 0.0) == 0.0}
    places = sorted(gap for gap, p in known.items() if p > 0)
    if not places:
        return lambda gaps: np.where(np.asarray(gaps) > curve.gaps[-1], 1.0, 0.0)
    without = np.flatnonzero(curve.gaps < places[0])
    if len(without) and known[places[0]] > 3 / curve.loops[without[-1]]:
        places.insert(0, int(curve.gaps[without[-1]]))
        known[places[0]] = 3 / int(curve.loops[without[-1]])
    x = np.array(places, np.float64)
    y = np.maximum.accumulate(np.log([known[gap] for gap in places]))
    rising = np.flatnonzero(y > y[0])
    slope = (y[rising[0]] - y[0]) / (x[rising[0]] - x[0]) if len(rising) else 0.0

    def probability(gaps: Floats) -> Floats:
        gaps = np.asarray(gaps, np.float64)
        logs = np.where(gaps < x[0], y[0] + slope * (gaps - x[0]), np.interp(gaps, x, y))
        beyond = gaps > curve.gaps[-1]
        return np.asarray(np.where(beyond, 1.0, np.exp(np.minimum(logs, 0.0))))

    return probability


@dataclasses.dataclass(frozen=True)
class LossyLink:
    """Loses transfers: a share ``loss`` of them, in runs of ``burst`` transfers on average.

    Independent losses have runs of 1 / (1 − loss).
    """

    loss: float
    burst: float

    @classmethod
    def independent(cls, loss: float) -> "LossyLink":
        """Return one whose losses are independent."""
        return cls(loss, 1 / (1 - loss))

    def runs_per_transfer(self) -> float:
        """Return how many runs of losses begin per transfer."""
        return self.loss / self.burst

    def run_lengths(self, most: int) -> Floats:
        """Return the probabilities of runs of 1 … ``most`` transfers; they are geometric."""
        stay = 1 - 1 / self.burst
        return np.asarray((1 - stay) * stay ** np.arange(most))


LONGEST_RUN = 100_000  # transfers


def losses_per_transfer(
    link: LossyLink, interval_steps: int, lost: Callable[[Floats], Floats]
) -> float:
    """Return how often control is lost on a link, per transfer, if each silence stands for itself.

    A run of n lost transfers is a gap of (n + 1) I steps. What is lost at a gap of I, without any
    silence, is not the link's.
    """
    most = int(np.clip(60 * link.burst, 64, LONGEST_RUN))
    gaps = np.arange(2, most + 2).astype(np.float64) * interval_steps
    weights = link.run_lengths(most)
    without = float(lost(np.array([float(interval_steps)]))[0])
    caused = np.maximum(lost(gaps) - without, 0.0)
    return float(link.runs_per_transfer() * weights @ caused)


def availability(link: LossyLink, interval_steps: int, survival_steps: float) -> float:
    """Return the communication service availability: the share of time in which it is not down.

    It is down from when the survival time has passed since a message was expected until the next
    one arrives (TS 22.104, clauses 3.1 and 5.1). Gaps are of whole transfers.
    """
    most = int(np.clip(60 * link.burst, 64, LONGEST_RUN))
    silent = np.arange(1, most + 1) * float(interval_steps)
    down = np.maximum(silent - survival_steps, 0.0) @ link.run_lengths(most)
    return float(1.0 - min(link.runs_per_transfer() * down / interval_steps, 1.0))


def tolerated_loss(
    interval_steps: int,
    lost: Callable[[Floats], Floats],
    losses_allowed: float,
    burst: float | None,
) -> float:
    """Return the largest share of lost transfers at which control is lost that seldom, or 0.

    Args:
        losses_allowed: of control, per transfer.
        burst: mean length of a run of losses in transfers; ``None``: independent ones.
    """

    def often(loss: float) -> bool:
        link = LossyLink.independent(loss) if burst is None else LossyLink(loss, burst)
        return losses_per_transfer(link, interval_steps, lost) > losses_allowed

    low, high = math.log(1e-15), math.log(0.5 if burst is None else min(0.5, burst / (burst + 1)))
    if often(math.exp(low)):
        return 0.0
    if not often(math.exp(high)):
        return math.exp(high)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if often(math.exp(middle)) else (middle, high)
    return math.exp(low)


def _draws(simulator: Simulator, steps: int, devices: int) -> Draws:
    protocol = dataclasses.replace(simulator.settings.protocol, warmup_steps=0, steps=steps)
    return Draws.make(protocol, devices, simulator.settings.seed)


def _drive(
    simulator: Simulator, method: str, draws: Draws, schedules: Bools, watch: Any, tick: Tick
) -> None:
    driver, loops = simulator.driver(method), schedules[:, 0].size
    simulate(
        simulator.plant,
        draws,
        schedules,
        driver.controller(loops),
        driver.sensor,
        delay_steps=driver.delay_steps,
        tick=lambda: tick(loops),
        watch=watch,
    )
