"""Plants of plugins are looked at when they answer.

NumPy would stretch a verdict on all devices to one of each, pictures of floats would become black
ones of bytes, and a cost that is NaN would be no score's. The package's own plants are used as they
are: tests know them, and a loop asks at every step.
"""

import functools
import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hjepa_cli.core.arrays import Bools, Floats, Pixels, array_from, check_answer, described, finite
from hjepa_cli.core.plants.cost import COST_CAP
from hjepa_cli.core.plants.frames import FRAME_SHAPE
from hjepa_cli.core.plants.guarded import guarded
from hjepa_cli.errors import ArrayError
from hjepa_cli.plugins import PLANTS

ROUNDED = 1e-6  # of a force limit, by which a teacher may exceed it


def look_at(kind: type) -> None:
    """Let the methods of a class of plants, of which it has these itself, be looked at."""
    for name, check in CHECKS.items():
        if name in vars(kind):
            setattr(kind, name, _looked_at(vars(kind)[name], check))


def _looked_at(method: Any, check: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(method)
    def answered(plant: Any, *given: Any, **named: Any) -> Any:
        def answer() -> Any:
            made = method.__get__(plant)(*map(_own, given), **named)
            return check(plant, made, *given, **named)

        return guarded(PLANTS, plant.name, answer)()

    return answered


def _own(given: Any) -> Any:
    """Return a copy of an array: what a plugin does to it is nobody else's."""
    return given.copy() if isinstance(given, np.ndarray) else given


def _numbers(
    found: Any, shape: tuple[int, ...], name: str, low: float = -math.inf, high: float = math.inf
) -> Floats:
    answer = finite(found, name)
    check_answer(answer, shape, name)
    if answer.size and not low <= answer.min() <= answer.max() <= high:
        raise ArrayError(f"{name} is {described(answer)}; expected {low:g} to {high:g}")
    return answer


def _verdict(name: str, plant: Any, found: Any, states: Floats) -> Bools:
    answer = array_from(found, name)
    check_answer(answer, np.shape(states)[:-1], name)
    if answer.dtype != bool:
        raise ArrayError(f"{name} is {described(answer)}; expected bool, as of a comparison")
    return answer


def _moved(name: str, plant: Any, found: Any, states: Floats, *by: Any) -> Floats:
    return _numbers(found, np.shape(states), name)


def _cost(plant: Any, found: Any, states: Floats, forces_n: Floats) -> Floats:
    return _numbers(found, np.shape(states)[:-1], "cost(…)", 0.0, COST_CAP)


def _teacher(plant: Any, found: Any) -> Callable[[ArrayLike], Floats]:
    if not callable(found):
        raise ArrayError(f"teacher() made {found!r}; expected a function")

    def forces_n(states: ArrayLike) -> Floats:
        given = finite(states, "states")
        shape, limit_n = (*given.shape[:-1], *plant.action_shape), plant.force_limit_n
        within_n = limit_n * (1 + ROUNDED)
        return _numbers(found(given.copy()), shape, "teacher()(…)", -within_n, within_n)

    return guarded(PLANTS, plant.name, forces_n)


class _Simulation:
    """A plugin's simulation; its states are nobody else's, as :class:`~.system.Integrated` has."""

    def __init__(
        self, plant: Any, found: Any, devices: int, *, mass_scale: ArrayLike | None = None
    ) -> None:
        self._inner, self._shape = found, (devices, len(plant.state_names))
        self._guard = functools.partial(guarded, PLANTS, plant.name)
        self._guard(self._states)()  # so that one without any is told at once

    def _states(self) -> Floats:
        return _numbers(self._inner.states, self._shape, "simulation(…).states").copy()

    @property
    def states(self) -> Floats:
        """Return the states [n, S]."""
        return self._guard(self._states)()

    @states.setter
    def states(self, states: ArrayLike) -> None:
        def take() -> None:
            self._inner.states = np.array(states)

        self._guard(take)()

    def step(self, forces_n: ArrayLike) -> None:
        """Advance by one control step."""
        self._guard(lambda: self._inner.step(np.array(forces_n)))()


class _Camera:
    """A plugin's camera, whose pictures are bytes of the usual size."""

    def __init__(self, plant: Any, found: Any) -> None:
        self._camera, self._states = found, len(plant.state_names)
        for name in ("render", "manifest", "sketch_px"):
            if not callable(getattr(found, name, None)):
                raise ArrayError(f"camera() made {found!r}, which has no {name}(…)")
            looked_at = guarded(PLANTS, plant.name, getattr(self, f"_{name}"))
            setattr(self, name, looked_at)

    def __getattr__(self, name: str) -> Any:
        """Return what else the camera has."""
        return getattr(self._camera, name)

    def _render(self, states: ArrayLike) -> Pixels:
        frames: Pixels = array_from(self._camera.render(np.array(states)), "render(…)")
        check_answer(frames, (len(np.asarray(states)), *FRAME_SHAPE), "render(…)")
        if frames.dtype != np.uint8:
            raise ArrayError(f"render(…) is {described(frames)}; expected uint8 from 0 to 255")
        return frames

    def _manifest(self) -> dict[str, Any]:
        manifest = self._camera.manifest()
        try:
            json.dumps(manifest, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ArrayError(f"manifest() is not plain: {error}") from None
        if not isinstance(manifest, dict):
            raise ArrayError(f"manifest() is {manifest!r}; expected a dict")
        return manifest

    def _sketch_px(self, state: ArrayLike) -> list[Floats]:
        lines = [finite(line, "sketch_px(…)") for line in self._camera.sketch_px(np.array(state))]
        for line in lines:
            check_answer(line, (len(line), 2), "a line of sketch_px(…)")
        if not lines:
            raise ArrayError("sketch_px(…) is no line; expected an axis, whose lean matters")
        return lines


CHECKS: dict[str, Callable[..., Any]] = {
    "simulation": _Simulation,
    "advance": functools.partial(_moved, "advance(…)"),
    "teacher": _teacher,
    "camera": _Camera,
    "in_band": functools.partial(_verdict, "in_band(…)"),
    "fallen": functools.partial(_verdict, "fallen(…)"),
    "cost": _cost,
    "sideways": functools.partial(_moved, "sideways(…)"),
}
