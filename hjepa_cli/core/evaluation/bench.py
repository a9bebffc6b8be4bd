"""The bench that all methods are compared on: one plant, one protocol, one set of draws."""

import copy
import threading
from collections.abc import Sequence
from typing import Any, Protocol, Self

import numpy as np

from hjepa_cli.config.settings import ProtocolSettings
from hjepa_cli.core import statistics
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.control.force_error import window_means
from hjepa_cli.core.control.loop import Outcome
from hjepa_cli.core.evaluation.protocol import (
    BESIDE,
    KINDS,
    Curves,
    Point,
    Reference,
    measure_curves,
)
from hjepa_cli.core.evaluation.simulator import (
    Pending,
    Runner,
    Tick,
    run_points,
    silent,
    start_points,
)

EVERY_STEP = Point("gap", 1.0)
TOLERANCES = (
    *("gap_steps", "gap_ci95", "gap_censored", "gap_lq_steps"),
    *("p", "p_ci95", "p_censored", "p_lq"),
    *(f"{kind}_{key}" for kind in ("gap", "p") for key in BESIDE),
)


class Described(Protocol):
    """What the bench must know of a method; see :class:`~hjepa_cli.core.control.methods.Method`."""

    @property
    def name(self) -> str: ...
    @property
    def family(self) -> str: ...
    @property
    def uses_link(self) -> bool: ...
    @property
    def bits_per_transmission(self) -> int: ...


class Bench:
    """Measures methods, and holds what they share: the teacher's run and each family's first point.

    Several threads may measure methods at a time, if the runner serves them.

    Args:
        protocol: draws, grid, devices, level.
        seed: of the bootstrap.
        runner: simulates.
        tick: shows progress; may be set to another one at any time.

    Attributes:
        reference: the teacher, on the true state at every step, with all devices.

    Raises:
        NumericalError: the teacher never is inside the band.
    """

    def __init__(
        self,
        protocol: ProtocolSettings,
        seed: int,
        runner: Runner,
        tick: Tick = silent,
    ) -> None:
        self.protocol, self.tick = protocol, tick
        self._runner, self._lock = runner, threading.Lock()
        devices = max(protocol.curve_devices, protocol.bracket_devices)
        teacher = self._at_every_step("optimal", devices)()
        few = protocol.curve_devices
        first = teacher.part(slice(None), slice(few))
        self._every_step: dict[str, Pending] = {"state": lambda: first}
        self.reference = Reference(teacher.score[0], teacher.cost[0], protocol.bootstrap, seed)
        # Now, not after the curves of the first method: every normalised score divides by it.
        statistics.reference_mean(self.reference.score[: min(few, protocol.bracket_devices)])

    @property
    def teacher_score(self) -> float:
        """The teacher's own share of steps inside the band; a sound protocol has 0.85 or more."""
        return float(self.reference.score.mean())

    def sharing(self, runner: Runner) -> Self:
        """A bench for the methods of another model, beside the same teacher."""
        other = copy.copy(self)
        other._runner, other._lock = runner, threading.Lock()
        other._every_step = {"state": self._every_step["state"]}
        return other

    def measure(self, method: str, points: Sequence[Point], devices: int) -> Outcome:
        """Simulate a method at curve points with the first ``devices`` draws: [P, devices]."""
        return run_points(self._runner, method, points, devices, self.tick)

    def curves(self, method: Described) -> Curves:
        """Both curves and the searches for both tolerances."""
        with self._lock:
            if method.family not in self._every_step:  # it runs beside the grids
                first = self._at_every_step(method.name, self.protocol.curve_devices)
                self._every_step[method.family] = first
        return measure_curves(
            lambda points, devices: self.measure(method.name, points, devices),
            self._every_step[method.family],
            self.reference,
            self.protocol,
        )

    def entry(self, method: Described) -> dict[str, Any]:
        """What ``eval --json`` prints about a method's closed loop."""
        if method.name == "optimal":
            return self._perfect_entry()
        if not method.uses_link:
            return self._flat_entry(method)
        curves = self.curves(method)
        described = {kind: self.reference.describe(*curves.grid[kind]) for kind in KINDS}
        brackets = {
            kind: self.reference.describe(search.points, search.outcome)
            for kind, search in curves.searches.items()
        }
        gap, delivery = (curves.searches[kind].result() for kind in KINDS)
        lq_gap, lq_delivery = (
            self._lq_tolerance(kind, described[kind] + brackets[kind]) for kind in KINDS
        )
        there = {
            f"tolerance_{name}_{key}": value
            for name, kind, found in (("gap", "gap", gap), ("p", "delivery", delivery))
            for key, value in _at(found.gap, described[kind] + brackets[kind]).items()
        }
        return {
            "score": described["gap"][0]["score"],
            "score_ci95": described["gap"][0]["ci95"],
            "lq_ratio": described["gap"][0]["lq_ratio"],
            "bits_per_transmission": method.bits_per_transmission,
            "tolerance_gap_steps": gap.gap,
            "tolerance_gap_ci95": list(gap.interval),
            "tolerance_gap_censored": gap.censored,
            "tolerance_gap_lq_steps": lq_gap,
            "tolerance_p": _probability(delivery.gap),
            "tolerance_p_ci95": [_probability(end) for end in reversed(delivery.interval)],
            "tolerance_p_censored": delivery.censored,
            "tolerance_p_lq": _probability(lq_delivery),
            **there,
            **self._scored,
            "gap_curve": described["gap"],
            "gap_bracket": brackets["gap"],
            "delivery_curve": described["delivery"],
            "delivery_bracket": brackets["delivery"],
            "n_devices": self.protocol.bracket_devices,
            "n_curve_devices": self.protocol.curve_devices,
        }

    @property
    def _scored(self) -> dict[str, int]:
        """What was scored, which tells how many packets a loop at its tolerance really sent."""
        return {"warmup_steps": self.protocol.warmup_steps, "scored_steps": self.protocol.steps}

    def _flat_entry(self, method: Described) -> dict[str, Any]:
        """Of a method without a link: one point measured, which is all of both its curves.

        It tolerates every link, if its score is acceptable at all.
        """
        protocol, reference = self.protocol, self.reference
        every = self._at_every_step(
            method.name, max(protocol.curve_devices, protocol.bracket_devices)
        )()
        few = slice(protocol.curve_devices)
        [point] = reference.describe([EVERY_STEP], every.part(slice(None), few))
        del point["d"]
        low, high = (
            float(end) for end in statistics.interval(reference.score_replicates(every)).ravel()
        )
        end = float(protocol.gaps[-1])

        def tolerated(score: float, level: float) -> float:
            return end if score >= level else 0.0

        level = protocol.acceptable_score
        gap = tolerated(float(reference.relative_score(every)[0]), level)
        ends = [tolerated(low, level), tolerated(high, level)]
        lq = tolerated(point["lq_ratio"], protocol.acceptable_lq_ratio)
        return {
            "score": point["score"],
            "score_ci95": point["ci95"],
            "lq_ratio": point["lq_ratio"],
            "bits_per_transmission": method.bits_per_transmission,
            "tolerance_gap_steps": gap,
            "tolerance_gap_ci95": ends,
            "tolerance_gap_censored": gap == end,
            "tolerance_gap_lq_steps": lq,
            "tolerance_p": _probability(gap),
            "tolerance_p_ci95": [_probability(end) for end in reversed(ends)],
            "tolerance_p_censored": gap == end,
            "tolerance_p_lq": _probability(lq),
            **{f"tolerance_{name}_{key}": point[key] for name in ("gap", "p") for key in BESIDE},
            **self._scored,
            **self._everywhere(point),
            "n_devices": protocol.bracket_devices,
            "n_curve_devices": protocol.curve_devices,
        }

    def _perfect_entry(self) -> dict[str, Any]:
        """Of the teacher at every step against itself: 1 wherever asked, nothing to tolerate."""
        protocol = self.protocol
        [point] = self.reference.describe([EVERY_STEP], self._every_step["state"]())
        point |= {"score": 1.0, "ci95": [1.0, 1.0], "lq_ratio": 1.0}  # no rounding
        del point["d"]
        return {
            "score": 1.0,
            "score_ci95": [1.0, 1.0],
            "lq_ratio": 1.0,
            "bits_per_transmission": None,
            **{f"tolerance_{name}": None for name in TOLERANCES},
            **self._everywhere(point),
            **self._scored,
            "n_devices": protocol.bracket_devices,
            "n_curve_devices": protocol.curve_devices,
        }

    def _everywhere(self, point: dict[str, Any]) -> dict[str, Any]:
        """Both curves of a method that meets the same at every point of the grid."""
        return {
            f"{kind}_{part}": [
                {**Point(kind, float(gap)).coordinate(), **point} for gap in self.protocol.gaps
            ]
            if part == "curve"
            else []
            for kind in KINDS
            for part in ("curve", "bracket")
        }

    def _lq_tolerance(self, kind: str, described: Sequence[dict[str, Any]]) -> float:
        """Where the LQ ratio falls below its own acceptable value, on all points that there are."""
        at = _by_gap(described)
        gaps = np.array(sorted(at))
        ratios = np.array([at[gap]["lq_ratio"] for gap in gaps])
        level = self.protocol.acceptable_lq_ratio
        crossing = statistics.first_crossing(gaps, ratios, level, log=kind == "delivery")
        return float(np.clip(crossing, 0.0, gaps[-1]))

    def _at_every_step(self, method: str, devices: int) -> Pending:
        return start_points(self._runner, method, [EVERY_STEP], devices, self.tick, reactive=True)


def control_entry(errors: Floats, every_step: Floats, replicates: int, seed: int) -> dict[str, Any]:
    """What ``eval --json`` prints about a method's control errors [R, horizon + 1].

    Args:
        errors: after the only packet.
        every_step: with a packet at every step.
        replicates, seed: of the bootstrap over rollouts.
    """
    weights = statistics.bootstrap_weights(len(errors), replicates, seed)
    windows = window_means(errors)
    at_once = every_step.mean(axis=1)
    return {
        "nmae": errors.mean(axis=0).tolist(),
        "nmae_ci95": statistics.mean_interval(errors, weights).T.tolist(),
        "nmae_windows": {name: float(values.mean()) for name, values in windows.items()},
        "nmae_windows_ci95": {
            name: statistics.mean_interval(values, weights).tolist()
            for name, values in windows.items()
        },
        "nmae_every_step": float(at_once.mean()),
        "nmae_every_step_ci95": statistics.mean_interval(at_once, weights).tolist(),
        "n_rollouts": len(errors),
    }


def _at(gap: float, described: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Interpolate what stands beside the score at a mean gap between the points around it."""
    at = _by_gap(described)
    gaps = sorted(at)
    return {key: float(np.interp(gap, gaps, [at[one][key] for one in gaps])) for key in BESIDE}


def _by_gap(described: Sequence[dict[str, Any]]) -> dict[float, dict[str, Any]]:
    """Points of a curve by their mean gap between packets in steps; of equal ones the last."""
    return {point["d"] if "d" in point else 1 / point["p"]: point for point in described}


def _probability(gap: float) -> float:
    """p = 1/g. A gap of 0 (not even every packet suffices) is p = 1: it leaves room for no one."""
    return 1 / gap if gap > 0 else 1.0
