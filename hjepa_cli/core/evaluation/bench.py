"""All methods are compared on one bench: one plant, one protocol, one set of draws."""

import copy
import dataclasses
import threading
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np

from hjepa_cli.config.schema import ProtocolSettings
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
    Tolerance,
    measure_curves,
)
from hjepa_cli.core.evaluation.simulator import (
    Pending,
    Runner,
    Tick,
    silent,
    start_points,
)

EVERY_STEP = Point("gap", 1.0)
NAMES = {"gap": "gap", "delivery": "p"}  # of tolerances, by the kind of curve
TOLERANCES = (
    *("gap_steps", "gap_ci95", "gap_censored", "gap_lq_steps"),
    *("p", "p_ci95", "p_censored", "p_lq"),
    *(f"{kind}_{key}" for kind in ("gap", "p") for key in BESIDE),
)


@dataclasses.dataclass(frozen=True)
class Facts:
    """Tells the bench about a :class:`~hjepa_cli.core.control.drivers.Driver`, as plain data."""

    name: str
    family: str
    uses_link: bool
    bits_per_transmission: int


class Bench:
    """Measures methods, and holds what they share: the teacher's run and each family's first point.

    Several threads may measure methods at a time, if the runner serves them.

    Args:
        protocol: draws, grid, devices, acceptable scores.
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
        """Return the teacher's own share of steps inside the band: 0.85 or more if all is well."""
        return float(self.reference.score.mean())

    def sharing(self, runner: Runner) -> Self:
        """Return a bench for the methods of another model, beside the same teacher."""
        other = copy.copy(self)
        other._runner, other._lock = runner, threading.Lock()
        other._every_step = {"state": self._every_step["state"]}
        return other

    def measure(self, method: str, points: Sequence[Point], devices: int) -> Outcome:
        """Simulate a method at curve points with the first ``devices`` draws: [P, devices]."""
        return start_points(self._runner, method, points, devices, self.tick)()

    def curves(self, method: Facts) -> Curves:
        """Measure both curves, and search for both tolerances."""
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

    def entry(self, method: Facts) -> dict[str, Any]:
        """Return what ``eval --json`` prints about a method's closed loop."""
        if method.name == "optimal":  # against itself: 1 everywhere, nothing to tolerate
            [point] = self.reference.describe([EVERY_STEP], self._every_step["state"]())
            point |= {"score": 1.0, "ci95": [1.0, 1.0], "lq_ratio": 1.0}  # no rounding
            return self._entry(point, None, {}, self._everywhere(point))
        if not method.uses_link:
            return self._flat_entry(method)
        curves = self.curves(method)
        tolerances: dict[str, Any] = {}
        measured: dict[str, Any] = {}
        for kind, name in NAMES.items():
            search = curves.searches[kind]
            curve = self.reference.describe(*curves.grid[kind])
            bracket = self.reference.describe(search.points, search.outcome)
            # By mean gap between packets in steps; of equal ones the last.
            points = {at["d"] if "d" in at else 1 / at["p"]: at for at in curve + bracket}
            found, gaps = search.result(), sorted(points)
            of = {key: np.array([points[gap][key] for gap in gaps]) for key in BESIDE}
            beside = {key: float(np.interp(found.gap, gaps, of[key])) for key in BESIDE}
            acceptable, log = self.protocol.acceptable_lq_ratio, kind == "delivery"
            lq = statistics.first_crossing(np.array(gaps), of["lq_ratio"], acceptable, log=log)
            lq_gap = float(np.clip(lq, 0.0, gaps[-1]))
            tolerances |= _tolerances(name, found, lq_gap, beside)
            measured |= {f"{kind}_curve": curve, f"{kind}_bracket": bracket}
        first = measured["gap_curve"][0]
        return self._entry(first, method.bits_per_transmission, tolerances, measured)

    def _flat_entry(self, method: Facts) -> dict[str, Any]:
        """Measure a method without a link at one point, which is all of both its curves.

        It tolerates every link, if its score is acceptable at all.
        """
        protocol, reference = self.protocol, self.reference
        devices = max(protocol.curve_devices, protocol.bracket_devices)
        every = self._at_every_step(method.name, devices)()
        few = every.part(slice(None), slice(protocol.curve_devices))
        [point] = reference.describe([EVERY_STEP], few)
        end = float(protocol.gaps[-1])

        low, high = statistics.interval(reference.score_replicates(every)).ravel()
        scores = np.array([reference.relative_score(every)[0], low, high])
        gap, low, high = np.where(scores >= protocol.acceptable_score, end, 0.0).tolist()
        found = Tolerance(gap, (low, high), gap == end)
        lq = end if point["lq_ratio"] >= protocol.acceptable_lq_ratio else 0.0
        tolerances: dict[str, Any] = {}
        for name in NAMES.values():
            tolerances |= _tolerances(name, found, lq, {key: point[key] for key in BESIDE})
        curves = self._everywhere(point)
        return self._entry(point, method.bits_per_transmission, tolerances, curves)

    def _entry(
        self,
        point: Mapping[str, Any],
        bits: int | None,
        tolerances: Mapping[str, Any],
        curves: Mapping[str, Any],
    ) -> dict[str, Any]:
        """Put an entry together; ``point`` is that of a packet at every step."""
        return {
            "score": point["score"],
            "score_ci95": point["ci95"],
            "lq_ratio": point["lq_ratio"],
            "bits_per_transmission": bits,
            **{f"tolerance_{name}": tolerances.get(name) for name in TOLERANCES},
            # What a loop at its tolerance really sent follows from these.
            "warmup_steps": self.protocol.warmup_steps,
            "scored_steps": self.protocol.steps,
            **curves,
            "n_devices": self.protocol.bracket_devices,
            "n_curve_devices": self.protocol.curve_devices,
        }

    def _everywhere(self, point: Mapping[str, Any]) -> dict[str, Any]:
        """Repeat a point at every place of both curves, where the link makes no difference."""
        same = {key: value for key, value in point.items() if key != "d"}
        curves: dict[str, Any] = {}
        for kind in KINDS:
            places = (Point(kind, float(gap)).coordinate() for gap in self.protocol.gaps)
            curves |= {f"{kind}_curve": [{**at, **same} for at in places], f"{kind}_bracket": []}
        return curves

    def _at_every_step(self, method: str, devices: int) -> Pending:
        return start_points(self._runner, method, [EVERY_STEP], devices, self.tick, reactive=True)


def control_entry(errors: Floats, every_step: Floats, replicates: int, seed: int) -> dict[str, Any]:
    """Return what ``eval --json`` prints about a method's control errors [R, horizon + 1].

    ``errors`` are those after the only packet, ``every_step`` those with a packet at every step;
    ``replicates`` and ``seed`` are of the bootstrap over rollouts.
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


def _tolerances(
    name: str, found: Tolerance, lq_gap: float, beside: Mapping[str, float]
) -> dict[str, Any]:
    """Name a tolerance's values as an entry does: gaps as they are, or as probabilities."""
    if name == "gap":
        values = {"steps": found.gap, "ci95": list(found.interval), "lq_steps": lq_gap}
    else:
        ends = [_probability(end) for end in reversed(found.interval)]
        values = {"": _probability(found.gap), "ci95": ends, "lq": _probability(lq_gap)}
    values |= {"censored": found.censored, **beside}
    return {f"{name}_{key}".strip("_"): value for key, value in values.items()}


def _probability(gap: float) -> float:
    """Return p = 1/g, and 1 for a gap of 0, where not even every packet suffices."""
    return 1 / gap if gap > 0 else 1.0
