"""The bench that all methods are compared on: one plant, one protocol, one set of draws."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.core import metrics
from hjepa_cli.core.loop import Controller, Draws, Floats, Outcome, every_step, play, simulate
from hjepa_cli.core.methods import Method, true_state_method
from hjepa_cli.core.plant import Plant
from hjepa_cli.core.protocol import KINDS, Curves, Point, Reference, measure_curves
from hjepa_cli.settings import ProtocolSettings

Tick = Callable[[], None]
"""Called after every simulated control step, for progress."""

TOLERANCES = (
    *("gap_steps", "gap_ci95", "gap_censored", "gap_lq_steps"),
    *("p", "p_ci95", "p_censored", "p_lq"),
)


class Bench:
    """Measures methods, and holds what they share: the draws and the teacher's run.

    Args:
        plant: the cart-pole.
        protocol: draws, grid, devices, level.
        seed: of draws and bootstrap.
        tick: see :data:`Tick`; may be set to another one at any time.

    Attributes:
        reference: the teacher, on the true state at every step, with all devices.
    """

    def __init__(
        self,
        plant: Plant,
        protocol: ProtocolSettings,
        seed: int,
        tick: Tick = lambda: None,
    ) -> None:
        self.plant, self.protocol, self.tick = plant, protocol, tick
        devices = max(protocol.curve_devices, protocol.bracket_devices)
        self._draws = Draws.make(protocol, devices, seed)
        self._every_step: dict[str, Outcome] = {}
        teacher = self._at_every_step(true_state_method("optimal", plant, 0), devices)
        self._every_step["state"] = _first(teacher, protocol.curve_devices)
        self.reference = Reference(teacher.score[0], teacher.cost[0], protocol.bootstrap, seed)

    @property
    def teacher_score(self) -> float:
        """The teacher's own share of steps inside the band; a sound protocol has 0.85 or more."""
        return float(self.reference.score.mean())

    def measure(self, method: Method, points: Sequence[Point], devices: int) -> Outcome:
        """Simulate a method at curve points with the first ``devices`` draws: [P, devices]."""
        draws = self._draws.first(devices)
        schedules = np.stack([point.schedule(draws) for point in points])
        return self._simulate(method, method.controller(schedules[:, 0].size), draws, schedules)

    def curves(self, method: Method) -> Curves:
        """Both curves and the searches for both tolerances."""
        if method.family not in self._every_step:
            first = self._at_every_step(method, self.protocol.curve_devices)
            self._every_step[method.family] = first
        return measure_curves(
            lambda points, devices: self.measure(method, points, devices),
            self._every_step[method.family],
            self.reference,
            self.protocol,
        )

    def entry(self, method: Method) -> dict[str, Any]:
        """What ``eval --json`` prints about a method's closed loop (spec §8)."""
        if not method.uses_link:
            return _flat_entry(self.protocol)
        curves = self.curves(method)
        described = {kind: self.reference.describe(*curves.grid[kind]) for kind in KINDS}
        brackets = {
            kind: self.reference.describe(search.points, search.outcome)
            for kind, search in curves.searches.items()
        }
        gap, delivery = (curves.searches[kind].result() for kind in KINDS)
        lq_gap, lq_delivery = (self._lq_tolerance(kind, described[kind]) for kind in KINDS)
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
            "gap_curve": described["gap"],
            "gap_bracket": brackets["gap"],
            "delivery_curve": described["delivery"],
            "delivery_bracket": brackets["delivery"],
            "n_devices": self.protocol.bracket_devices,
            "n_curve_devices": self.protocol.curve_devices,
        }

    def _lq_tolerance(self, kind: str, curve: Sequence[dict[str, Any]]) -> float:
        """Where the grid's LQ ratio falls below its own acceptable value; like the tolerance."""
        gaps = np.array(self.protocol.gaps, dtype=np.float64)
        ratios = np.array([entry["lq_ratio"] for entry in curve])
        level = self.protocol.acceptable_lq_ratio
        crossing = metrics.first_crossing(gaps, ratios, level, log=kind == "delivery")
        return float(np.clip(crossing, 0.0, gaps[-1]))

    def _at_every_step(self, method: Method, devices: int) -> Outcome:
        draws = self._draws.first(devices)
        schedule = every_step(draws.steps, devices)[None]
        return self._simulate(method, method.reactive(devices), draws, schedule)

    def _simulate(
        self, method: Method, controller: Controller, draws: Draws, schedules: NDArray[np.bool_]
    ) -> Outcome:
        # The tick is looked up at every step: it changes with the method being measured.
        return simulate(
            self.plant, draws, schedules, controller, method.sensor, tick=lambda: self.tick()
        )


def control_errors(
    method: Method, states: Floats, teacher_n: Floats, force_limit_n: float, horizon: int
) -> Floats:
    """Control error of a controller left alone after one packet, on given rollouts.

    Args:
        method: how to drive.
        states: rollouts [R, steps + 1, 4]; index 0 is the frame before k = 0.
        teacher_n: the teacher's forces on them [R, steps].
        force_limit_n: half of the force range.
        horizon: last j; the packet at k = 0 is j = 0.

    Returns:
        |ũ - u*| ÷ force range [R, horizon + 1].
    """
    rollouts = len(states)
    controller = method.controller(rollouts)
    if method.uses_link:
        packets = method.sensor(states[:, 0], states[:, 1])
        forces_n = play(controller, packets, rollouts, horizon + 1)
    else:
        all_of_them = np.ones(rollouts, dtype=bool)
        forces_n = np.stack(
            [
                controller.act(all_of_them, method.sensor(states[:, j], states[:, j + 1]))
                for j in range(horizon + 1)
            ],
            axis=1,
        )
    forces_n = np.clip(forces_n, -force_limit_n, force_limit_n)
    return metrics.control_error(forces_n, teacher_n[:, : horizon + 1], force_limit_n)


def control_entry(errors: Floats, replicates: int, seed: int) -> dict[str, Any]:
    """What ``eval --json`` prints about a method's control error [R, horizon + 1] (spec §8)."""
    weights = metrics.bootstrap_weights(len(errors), replicates, seed)
    windows = metrics.window_means(errors)
    return {
        "nmae": errors.mean(axis=0).tolist(),
        "nmae_ci95": metrics.mean_interval(errors, weights).T.tolist(),
        "nmae_windows": {name: float(values.mean()) for name, values in windows.items()},
        "nmae_windows_ci95": {
            name: metrics.mean_interval(values, weights).tolist()
            for name, values in windows.items()
        },
        "n_rollouts": len(errors),
    }


def _flat_entry(protocol: ProtocolSettings) -> dict[str, Any]:
    """The teacher at every step against itself: 1 wherever it is asked, nothing to tolerate."""
    perfect = {
        "score": 1.0,
        "ci95": [1.0, 1.0],
        "lq_ratio": 1.0,
        "n_devices": protocol.curve_devices,
    }
    return {
        "score": 1.0,
        "score_ci95": [1.0, 1.0],
        "lq_ratio": 1.0,
        "bits_per_transmission": None,
        **{f"tolerance_{name}": None for name in TOLERANCES},
        **{
            f"{kind}_curve": [
                {**Point(kind, float(gap)).coordinate(), **perfect} for gap in protocol.gaps
            ]
            for kind in KINDS
        },
        **{f"{kind}_bracket": [] for kind in KINDS},
        "n_devices": protocol.bracket_devices,
        "n_curve_devices": protocol.curve_devices,
    }


def _probability(gap: float) -> float:
    """p = 1/g. A gap of 0 (not even every packet suffices) is p = 1: it leaves room for no one."""
    return 1 / gap if gap > 0 else 1.0


def _first(outcome: Outcome, devices: int) -> Outcome:
    return Outcome(outcome.score[:, :devices], outcome.cost[:, :devices])
