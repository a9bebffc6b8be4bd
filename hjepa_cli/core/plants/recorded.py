"""A plant may be known from recordings alone: a dataset says what it is, nobody simulates it.

Forces are in units of each action's limit, so that the force limit is 1.
"""

import dataclasses
from typing import Any, NoReturn

from numpy.typing import ArrayLike

from hjepa_cli.config.schema import RECORDED, CameraSettings, RecordedSettings
from hjepa_cli.core.arrays import Bools, Floats, Pixels
from hjepa_cli.core.plants.frames import Camera
from hjepa_cli.core.plants.system import Simulation, System, Teacher
from hjepa_cli.errors import UsageError


@dataclasses.dataclass(frozen=True)
class Recorded(System):
    """These numbers are all that is known; what needs equations raises a UsageError."""

    name: str = RECORDED
    step_s: float = 0.02
    force_limit_n: float = 1.0
    limits: tuple[float, ...] = (1.0,)
    state_names: tuple[str, ...] = ()  # type: ignore[misc]
    mirror: float | tuple[float, ...] = -1.0  # type: ignore[misc]
    symmetric: bool = False

    @classmethod
    def of(cls, known: RecordedSettings) -> "Recorded":
        """Return the plant that a dataset describes.

        Raises:
            UsageError: there is no action, or not one sign for each.
        """
        count = len(known.limits)
        if not count:
            raise UsageError("recorded.limits is empty; a plant has at least one action")
        if known.mirror and (len(known.mirror) != count or {*map(abs, known.mirror)} != {1.0}):
            raise UsageError(
                f"recorded.mirror = {list(known.mirror)}; expected 1 or -1 for each of {count} "
                "actions, or nothing"
            )
        signs = known.mirror or (-1.0,) * count
        return cls(
            step_s=known.step_s,
            limits=known.limits,
            state_names=known.states,
            mirror=signs if count > 1 else signs[0],
            symmetric=bool(known.mirror),
        )

    @property
    def action_shape(self) -> tuple[int, ...]:  # type: ignore[override]
        """Return () for one action, and (m,) for m."""
        count = len(self.limits)
        return (count,) if count > 1 else ()

    @property
    def state_units(self) -> tuple[str, ...]:  # type: ignore[override]
        """Return no unit for each state: recordings do not say any."""
        return ("",) * len(self.state_names)

    @property
    def unstable_rate_rad_s(self) -> float:
        """Return 0, which bounds no rate: nobody knows."""
        return 0.0

    def simulation(self, devices: int, *, mass_scale: ArrayLike | None = None) -> Simulation:
        """Refuse."""
        _refuse("be simulated")

    def advance(self, states: Floats, forces_n: Floats) -> Floats:
        """Refuse."""
        _refuse("be simulated")

    def teacher(self) -> Teacher:
        """Return a law that refuses: the only answers that are known are the recorded ones."""
        return _unknown_law

    def camera(self) -> Camera:
        """Return a camera that has taken its pictures, and takes no others."""
        return RecordedCamera(CameraSettings().frame_shape)

    def in_band(self, states: Floats) -> Bools:
        """Refuse."""
        _refuse("be scored")

    def cost(self, states: Floats, forces_n: Floats) -> Floats:
        """Refuse."""
        _refuse("be scored")


class RecordedCamera:
    """It took pictures of ``frame_shape`` once."""

    def __init__(self, frame_shape: tuple[int, int, int]) -> None:
        self.frame_shape = frame_shape

    def render(self, states: ArrayLike) -> Pixels:
        """Refuse."""
        _refuse("be seen")

    def manifest(self) -> dict[str, Any]:
        """Return the size of its pictures."""
        return {"version": 1, "frame_shape": list(self.frame_shape)}

    def sketch_px(self, state: ArrayLike) -> list[Floats]:
        """Refuse."""
        _refuse("be drawn")


def _unknown_law(states: ArrayLike) -> Floats:
    _refuse("be asked what it would do elsewhere")


def _refuse(verb: str) -> NoReturn:
    raise UsageError(
        f"a recorded plant cannot {verb}: there are recordings of it, and no simulator",
        hint="hjepa eval --dataset DIR, which needs none",
    )


UNKNOWN = Recorded()
