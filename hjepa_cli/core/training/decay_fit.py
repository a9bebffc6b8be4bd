"""A decaying hold is fitted by the gap that it tolerates, on devices that no evaluation draws.

Where packets are late it can fail with a packet at every step, and do well with few: then no gap is
tolerated, however short, and it is fitted by its score at one gap.

Gains and decay belong together. A law that is right with a packet at every step is too slow for
sparse ones; a stiffer law whose force fades in time is a pulse that leaves a device at rest. So
both are searched at once, on the true state, where many candidates cost little. What a trained
actor makes of such a law is then corrected on embeddings, by a factor and the time alone.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from hjepa_cli.config.schema import ProtocolSettings
from hjepa_cli.core.arrays import Bools, Floats
from hjepa_cli.core.control.bounds import STATE_LIMIT
from hjepa_cli.core.control.controllers import LastForce, Oracle
from hjepa_cli.core.control.link import InFlight
from hjepa_cli.core.control.loop import Draws, Sensor, gap_schedule, simulate
from hjepa_cli.core.control.sensors import true_state
from hjepa_cli.core.plants.linear import gains_at_rest
from hjepa_cli.core.plants.system import System, Teacher
from hjepa_cli.core.statistics import first_crossing, ratio
from hjepa_cli.core.training.search import best

SEARCH_SEED = 2_000_003  # added to the seed: searches see other devices than any evaluation
AROUND = (0.5, 0.7, 0.85, 1.0, 1.15)  # of the oracle's tolerated gap: where candidates are tried
TIE = 0.1  # weight of the mean score beside the tolerated gap ÷ the longest that is tried


@dataclasses.dataclass(frozen=True, eq=False)
class Trial:
    """Candidates are compared in these closed loops, all on the same draws.

    Attributes:
        kind: the nominal plant.
        law: what devices play that know their state.
        draws: those of N devices.
        gaps: steps between packets [G].
        acceptable: the acceptable score ÷ the teacher's.
        teacher: the teacher's share of these steps in the band, with the true state at each step.
    """

    kind: System
    law: Teacher
    draws: Draws
    gaps: Floats
    acceptable: float
    teacher: Floats

    @classmethod
    def make(
        cls,
        kind: System,
        law: Teacher,
        protocol: ProtocolSettings,
        *,
        devices: int,
        steps: int,
        seed: int,
        around: Sequence[float] = AROUND,
        gap_steps: int = 0,
    ) -> "Trial":
        """Draw devices, and find the gaps to try them at: ``around`` what the law tolerates.

        That is with the true state and the exact equations; ``gap_steps`` are tried alone. The
        ``protocol``'s devices all are nominal here, and ``steps`` are scored after its warm-up.
        """
        nominal = dataclasses.replace(protocol, steps=steps, plant_spread=0.0)
        draws = Draws.make(nominal, devices, seed + SEARCH_SEED)
        states = len(kind.state_names)

        def shares(act: Teacher, gaps: Floats, draws: Draws) -> Floats:
            loops = devices * len(gaps)
            limit_n, shape = kind.force_limit_n, kind.action_shape
            oracle = Oracle(act, kind.advance, limit_n, loops, states=states, action_shape=shape)
            trial = cls(kind, law, draws, gaps, protocol.acceptable_score, np.ones(devices))
            return trial.shares(oracle, true_state)

        grid = np.array(protocol.gaps, float)
        (teacher,) = shares(kind.teacher(), np.ones(1), draws.on_device)
        scores = ratio(shares(law, grid, draws), teacher)
        tolerated = float(first_crossing(grid, scores, protocol.acceptable_score, log=False))
        tolerated = float(np.clip(tolerated, grid[min(1, len(grid) - 1)], grid[-1]))
        tried = np.array([gap_steps]) if gap_steps else np.array(around) * tolerated
        gaps = np.clip(tried.astype(float), 1.0, steps)
        return cls(kind, law, draws, gaps, protocol.acceptable_score, teacher)

    def first(self, devices: int) -> "Trial":
        """Return the same with fewer devices, or as many as there are."""
        part = slice(min(devices, self.draws.devices))
        return dataclasses.replace(self, draws=self.draws.part(part), teacher=self.teacher[part])

    @property
    def schedules(self) -> Bools:
        """Return when packets arrive [G, steps, N]."""
        draws = self.draws
        return np.stack([gap_schedule(gap, draws.steps, draws.devices) for gap in self.gaps])

    def shares(self, controller: Any, sensor: Sensor, candidates: int = 1) -> Floats:
        """Return the share of scored steps in the band [C · G, N], candidate by candidate.

        ``controller`` drives C · G · N devices.
        """
        schedules = np.tile(self.schedules, (candidates, 1, 1))
        # What falls goes on here, as it did when the zoo's reflexes were fitted: the same numbers.
        return simulate(self.kind, self.draws, schedules, controller, sensor, ends=False).score

    def quality(self, shares: Floats) -> Floats:
        """Say how good candidates are [C], from :meth:`shares`.

        It is the tolerated gap ÷ the longest that is tried, and a little of the mean score, which
        still tells where no gap is tolerated or all are.
        """
        scores = ratio(shares, self.teacher).reshape(-1, len(self.gaps))
        tolerated = first_crossing(self.gaps, scores, self.acceptable, log=False)
        tolerated = np.clip(tolerated, 0.0, self.gaps[-1])
        return np.asarray(tolerated / self.gaps[-1] + TIE * scores.mean(axis=1))


@dataclasses.dataclass(frozen=True, eq=False)
class Law:
    """The force is u = −K x at a packet, then e^(−j/τ) of it at age j."""

    gains_n: Floats  # K [m, S], N per unit of state
    tau_steps: float  # τ


def search_law(
    trial: Trial, *, candidates: int, rounds: int, seed: int, tied: bool = False
) -> tuple[Law, float]:
    """Find K and τ together, on the true state; return the law and its factor.

    K is sought as factors of the gains at rest of the trial's law, each gain with a factor of its
    own or, ``tied``, one for all. Otherwise the factor is in the gains, and 1 is returned.
    """
    gains_n = gains_at_rest(trial.law, len(trial.kind.state_names))
    factors = 1 if tied else gains_n.size

    def law(candidate: Floats) -> tuple[Floats, Floats]:
        shape = (len(candidate), 1, 1) if tied else (len(candidate), *gains_n.shape)
        return gains_n * np.exp(candidate[:, :-1]).reshape(shape), np.exp(candidate[:, -1])

    start = np.zeros(factors + 1)
    start[-1] = 0.5 * np.log(trial.gaps[-1])
    found = best(
        lambda candidate: trial.quality(shares_of_laws(trial, *law(candidate))),
        start,
        np.full(factors + 1, 0.7),
        candidates=candidates,
        rounds=rounds,
        seed=seed,
    )
    gains, tau = law(found[None])
    return Law(gains[0], float(tau[0])), float(np.exp(found[0])) if tied else 1.0


def shares_of_laws(trial: Trial, gains_n: Floats, tau_steps: Floats) -> Floats:
    """Return :meth:`Trial.shares` of laws K [C, m, S] and τ [C] on the true state.

    The plant's exact equations move many candidates at once. Packets are late as the draws say; no
    force is lost.
    """
    kind, draws, schedules = trial.kind, trial.draws, trial.schedules
    count, shape = len(gains_n), (len(gains_n), len(trial.gaps), draws.devices)
    forces_n = np.zeros((*shape, gains_n.shape[1]))
    action = (*shape, *kind.action_shape)
    kept = np.exp(-1.0 / tau_steps).reshape(count, 1, 1, 1)
    initial = np.broadcast_to(draws.initial, (*shape, draws.initial.shape[1]))
    states = kind.advance(initial, forces_n.reshape(action))
    inside = np.zeros(shape)
    link = draws.link.tiled(len(trial.gaps))
    in_flight = InFlight(link.delay_steps, link.extra_steps)
    for k in range(draws.steps):
        gap, device = np.nonzero(schedules[:, k])
        packets = states[:, gap, device].swapaxes(0, 1)  # [packets, C, S]
        arrived, packets, _ = in_flight.pass_on(schedules[:, k].ravel(), packets)
        if packets is not None:
            gap, device = np.nonzero(arrived.reshape(shape[1:]))
            seen = packets.swapaxes(0, 1)
            forces_n[:, gap, device] = -np.einsum("cms,cps->cpm", gains_n, seen)
        if k >= draws.warmup_steps:
            inside += kind.in_band(states)
        applied_n = np.clip(forces_n, -kind.force_limit_n, kind.force_limit_n)
        states = kind.advance(states, applied_n.reshape(action)) + draws.noise[k]
        states = np.clip(states, -STATE_LIMIT, STATE_LIMIT)
        forces_n *= kept
    return inside.reshape(-1, draws.devices) / (draws.steps - draws.warmup_steps)


def fit_decay(
    trial: Trial,
    actor: Callable[[Any], Any],
    sensor: Sensor,
    start: tuple[float, float],
    *,
    candidates: int,
    rounds: int,
    seed: int,
) -> tuple[float, float]:
    """Return s and τ in steps for an actor on what a sensor really sends, from ``start`` on."""
    kind = trial.kind
    loops = len(trial.gaps) * trial.draws.devices

    def evaluate(candidate: Floats) -> Floats:
        gains, taus = np.repeat(np.exp(candidate), loops, axis=0).T
        controller = LastForce(
            actor,
            len(gains),
            gain=gains,
            tau_steps=taus,
            force_limit_n=kind.force_limit_n,
            action_shape=kind.action_shape,
        )
        return trial.quality(trial.shares(controller, sensor, len(candidate)))

    found = best(
        evaluate,
        np.log(np.array(start)),
        np.full(2, 0.3),
        candidates=candidates,
        rounds=rounds,
        seed=seed,
    )
    gain, tau_steps = np.exp(found)
    return float(gain), float(tau_steps)
