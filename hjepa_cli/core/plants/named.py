"""Plants are found by their names, as users give them."""

import dataclasses
import hashlib
import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hjepa_cli import plugins
from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.schema import CameraSettings, RecordedSettings, SensorSettings, Settings
from hjepa_cli.core.arrays import Floats, array_from, described, finite
from hjepa_cli.core.plants.cartpole import camera
from hjepa_cli.core.plants.cartpole.plant import CartPolePlant
from hjepa_cli.core.plants.cartpole.simulation import CartPoles
from hjepa_cli.core.plants.frames import FRAME_SHAPE
from hjepa_cli.core.plants.frames import Camera as SystemCamera
from hjepa_cli.core.plants.recorded import Recorded, RecordedCamera
from hjepa_cli.core.plants.resizing import Resized
from hjepa_cli.core.plants.sensor import Sensed
from hjepa_cli.core.plants.system import System, Teacher
from hjepa_cli.errors import ArrayError, UsageError

IDEAL = SensorSettings()
Section = TypeVar("Section")
START = np.array([0.03, 0.1, 0.08, 0.5])  # m, m/s, rad, rad/s: where a seeded CartPole starts


def plant(name: str) -> System:
    """Return the plant called ``name``.

    Raises:
        UsageError: there is none, naming the valid choices.
    """
    found: System = plugins.PLANTS[name]
    return found


def plant_of(settings: Settings) -> System:
    """Return the plant of the settings, after checking that they have one value per state.

    Raises:
        UsageError: they do not.
    """
    kind = plant(settings.plant)
    checked = [
        ("collect.start", settings.collect.half_widths),
        ("encoder.gate_r2", settings.encoder.least_r2),
        ("protocol.start", settings.protocol.half_widths),
        ("protocol.noise", settings.protocol.velocity_noise),
    ]
    if isinstance(kind, Recorded):
        kind, gates = Recorded.of(settings.recorded), settings.encoder.gate_r2
        checked = [("encoder.gate_r2", gates)] if gates else []
    for name, values in checked:
        if len(values) != len(kind.state_names):
            raise UsageError(
                f"{name} has {len(values)} values; plant {kind.name} has {len(kind.state_names)} "
                f"states: {', '.join(kind.state_names)}",
                hint=f"--plant {kind.name}, or a --config FILE.toml that sets {name}",
                key=name,
            )
    return kind


def plant_in(name: str, settings: Mapping[str, Any]) -> System:
    """Return the plant called ``name`` in a dataset or a checkpoint with these settings.

    Raises:
        UsageError: there is no such plant, or the settings describe no recorded one.
    """
    kind = plant(name)
    if not isinstance(kind, Recorded):
        return kind
    try:
        return Recorded.of(msgspec.convert(settings["recorded"], RecordedSettings))
    except (msgspec.ValidationError, LookupError, TypeError) as flaw:
        raise UsageError(f"a recorded plant without a sound description: {flaw}") from None


def camera_in(settings: Mapping[str, Any]) -> CameraSettings:
    """Return the size of pictures in a dataset or a checkpoint with these settings.

    Raises:
        UsageError: it is none.
    """
    return _section(settings, "camera", CameraSettings, "size of pictures")


def sensor_in(record: Mapping[str, Any]) -> SensorSettings:
    """Return the sensor in settings of a dataset or a checkpoint, or in a camera's manifest.

    Raises:
        UsageError: it is none.
    """
    return _section(record, "sensor", SensorSettings, "sensor of a camera")


def _section(record: Mapping[str, Any], name: str, kind: type[Section], what: str) -> Section:
    try:
        return msgspec.convert(record.get(name, {}), kind)
    except (msgspec.ValidationError, AttributeError) as flaw:
        raise UsageError(f"no {what}: {flaw}") from None


def seen_as_trained(settings: Settings, record: Mapping[str, Any]) -> Settings:
    """Return settings with the sensor that a model was trained with, unless they have their own.

    ``record`` is what is known of the model: its settings, or the manifest of its camera.

    Raises:
        UsageError: it names no sensor.
    """
    own = settings.sensor != IDEAL
    return settings if own else dataclasses.replace(settings, sensor=sensor_in(record))


def camera_of(kind: System, size: CameraSettings, sensor: SensorSettings = IDEAL) -> SystemCamera:
    """Return a plant's camera, its pictures resized by area where ``size`` is not their own.

    A ``sensor`` that is not ideal takes them then.

    Raises:
        UsageError: the plant does not move as the sensor's exposure needs it.
    """
    if isinstance(kind, Recorded):
        return RecordedCamera(size.frame_shape)
    camera = kind.camera()
    if size.frame_shape != FRAME_SHAPE:
        camera = Resized(camera, size.frame_shape)
    return Sensed(camera, kind, sensor) if sensor.works else camera


def definition(name: str) -> str | None:
    """Return the digest of the file that defines a plant: measurements depend on it.

    ``None`` for the package's own: :data:`hjepa_cli.core.control.loop.LOOP_VERSION` tells theirs
    apart.
    """
    if name in plugins.BUILT_IN["plant"]:
        return None
    if source := plugins.PLANTS.source(name):
        return source.sha256
    file = inspect.getsourcefile(type(plant(name)))
    assert file is not None
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()


def cart_pole(which: CartPolePlant | str) -> CartPolePlant:
    """Return a plant, given as such or by name, that is a cart-pole.

    Raises:
        UsageError: it is not.
    """
    kind = plant(which) if isinstance(which, str) else which
    if not isinstance(kind, CartPolePlant):
        choices = [name for name in plugins.PLANTS if isinstance(plant(name), CartPolePlant)]
        raise UsageError(f"plant '{kind.name}' is no cart-pole; choose one of {', '.join(choices)}")
    return kind


def teacher(preset: System | str) -> Teacher:
    """Return the teacher of a plant, given as such or by name.

    It is a function from states ``[..., S]`` to forces ``[..., *A]`` in N within ±
    ``force_limit_n``; for a cart-pole from ``[..., 4]`` to ``[...]``
    (:func:`hjepa_cli.core.plants.cartpole.teacher.sdre`).

    Raises:
        UsageError: unknown plant.
    """
    return (plant(preset) if isinstance(preset, str) else preset).teacher()


class Camera(camera.Camera):
    """It looks at a cart-pole, given as a plant or its name.

    Raises:
        UsageError: unknown plant, or no cart-pole.
    """

    def __init__(self, plant: CartPolePlant | str) -> None:
        super().__init__(cart_pole(plant))


def _of_size(size: int, values: ArrayLike, name: str) -> NDArray[Any]:
    """Return so many values in one row; raise ArrayError for any other number of them."""
    array = array_from(values, name)
    if array.size != size:
        raise ArrayError(f"{name}: {described(array)}; expected {size} finite numbers")
    return array.reshape(size)


class CartPole:
    """It simulates one cart-pole, given as a plant or by its name, ``"desktop"`` or ``"gym"``.

    A ``seed`` draws the initial state, uniform within ± :data:`START`; without one it is upright
    and at rest.

    Raises:
        UsageError: unknown plant, or no cart-pole.
        NumericalError: a state, a force or noise is not finite; the cart-pole stays as it was.
        ArrayError: a state, a force or noise is not so many numbers.
    """

    def __init__(self, preset: CartPolePlant | str, *, seed: int | None = None) -> None:

        self._poles = CartPoles(cart_pole(preset), 1)
        self.plant = self._poles.plant
        if seed is not None:
            self.state = generator(seed).uniform(-1, 1, 4) * START

    @property
    def state(self) -> Floats:
        """Return the state ``[4]``: x [m], x_dot [m/s], theta [rad], theta_dot [rad/s]."""
        return self._poles.states.reshape(4)

    @state.setter
    def state(self, state: ArrayLike) -> None:
        self._poles.states = _of_size(4, state, "state").reshape(1, 4)

    def step(self, force_n: float, *, noise: ArrayLike | None = None) -> Floats:
        """Advance by one control step and return the new state ``[4]``.

        Args:
            force_n: force on the cart [N], clipped to ± ``plant.force_limit_n``.
            noise: ``[4]`` added to the state after the step; ``None`` adds none.
        """
        added = None
        if noise is not None:
            found = finite(noise, "noise")
            added = np.broadcast_to(found if found.ndim == 0 else _of_size(4, found, "noise"), 4)
        self._poles.step(_of_size(1, force_n, "force_n").reshape(1))
        if added is not None:
            self.state = self.state + added
        return self.state
