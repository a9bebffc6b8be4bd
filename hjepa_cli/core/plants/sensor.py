"""A lens and a sensor make of the ideal picture of a scene what a camera delivers.

In the order that light meets them: the ground has stains, things move while the shutter is open,
the lens distorts and darkens towards the corners, photons and electronics are noise in each pixel's
one colour, the other colours are filled in, and values are whole grey levels from 0 to 255. The
model is ours; its parts are the usual ones of a linear sensor (EMVA 1288: the variance of a value
is that of reading it plus one in proportion to it), and :mod:`hjepa_cli.core.plants.corruptions`
has them, in the units of its functions.
"""

import dataclasses
import functools
import zlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.schema import SensorSettings
from hjepa_cli.core.arrays import Floats, Pixels, finite
from hjepa_cli.core.plants import corruptions
from hjepa_cli.core.plants.corruptions import Pictures, as_bytes
from hjepa_cli.core.plants.frames import FRAME_SHAPE, Camera
from hjepa_cli.core.plants.system import System
from hjepa_cli.errors import UsageError

VERSION = 1  # raise it whenever any picture changes
OPEN = 8  # moments of an exposure whose pictures are averaged
TOGETHER = 32  # pictures made at a time: floats take four times as much memory as pixels
_NOISE_KEY = 0x5E25
_RATE = "_dot"  # ends the name of a state's rate


class Sensed:
    """A plant's camera has a lens and a sensor.

    What is random is drawn by the state that a picture shows. So a picture is the same whenever,
    wherever and among whichever others it is taken, and states of other seeds have other noise; but
    a plant that does not move at all is seen with the same noise twice.

    Args:
        camera: takes the ideal pictures.
        kind: the plant that it looks at.
        sensor: what it has.

    Raises:
        UsageError: an exposure longer than a control step, or of a plant whose states have no
            rates; a colour mosaic of grey pictures.
    """

    def __init__(self, camera: Camera, kind: System, sensor: SensorSettings) -> None:
        self._camera, self._sensor = camera, sensor
        self.frame_shape = getattr(camera, "frame_shape", FRAME_SHAPE)
        if sensor.bayer and self.frame_shape[2] == 1:
            raise UsageError(
                "sensor.bayer = true is a mosaic of colours; these pictures are grey",
                key="sensor.bayer",
            )
        self._rates = rates_of(kind.state_names)
        _check_exposure(sensor.exposure_ms, kind, self._rates)

    def render(self, states: ArrayLike) -> Pixels:
        """Return frames ``[n, H, W, C]`` of states ``[n, S]``, each when the shutter closes."""
        states = finite(states, "states")
        frames = np.empty((len(states), *self.frame_shape), np.uint8)
        for start in range(0, len(states), TOGETHER):
            part = states[start : start + TOGETHER]
            frames[start : start + TOGETHER] = self._developed(self._exposed(part), part)[:, 0]
        return frames

    def manifest(self) -> dict[str, Any]:
        """Return the camera's manifest with what the sensor does."""
        does = {
            field.name: value
            for field in dataclasses.fields(SensorSettings)
            if (value := getattr(self._sensor, field.name)) != field.default
        }
        return self._camera.manifest() | {"sensor": {"version": VERSION, **does}}

    def sketch_px(self, state: ArrayLike) -> list[Floats]:
        """Return the camera's sketch, without the distortion of the lens."""
        return self._camera.sketch_px(state)

    def _exposed(self, states: Floats) -> Pictures:
        """Return the mean ``[n, 1, H, W, C]`` of pictures while the shutter was open.

        It closes at the states ``[n, S]``. Those before, on the way from step k − 1 to k, are
        extrapolated from k by the rates in it: x(t − s) ≈ x − s ẋ. That leaves out ½ s² ẍ, as
        nobody tells a camera the force, and needs no other state than the one that is shown.
        """
        exposure_s = 1e-3 * self._sensor.exposure_ms
        if not exposure_s:
            return self._camera.render(states)[:, None].astype(np.float32)
        seconds_ago = exposure_s * (np.arange(OPEN) + 0.5) / OPEN
        shown = states - seconds_ago[:, None, None] * (states @ self._rates)
        frames = self._camera.render(shown.reshape(-1, states.shape[1]))
        by_moment = frames.reshape(OPEN, len(states), 1, *frames.shape[1:])
        return np.asarray(by_moment.mean(axis=0, dtype=np.float32))

    def _developed(self, pictures: Pictures, states: Floats) -> Pixels:
        """Return what lens and sensor make of pictures ``[n, 1, H, W, C]`` of states ``[n, S]``."""
        sensor, random = self._sensor, generator(_NOISE_KEY)  # which still effects do not ask
        if sensor.white != 255:
            pictures = corruptions.light(pictures, sensor.white / 255, random)
        if sensor.texture:
            pictures = on_the_ground(pictures, sensor.texture)
        if sensor.distortion:
            pictures = corruptions.lens(pictures, sensor.distortion, random)
        if sensor.vignette:
            pictures = corruptions.vignette(pictures, sensor.vignette, random)
        if sensor.shot_noise or sensor.read_noise:
            pictures = np.concatenate(
                [
                    self._noisy(picture[None], state)
                    for picture, state in zip(pictures, states, strict=True)
                ]
            )
        if sensor.bayer:
            pictures = corruptions.demosaiced(pictures)
        return as_bytes(pictures)

    def _noisy(self, picture: Pictures, state: Floats) -> Pictures:
        """Return a picture ``[1, 1, H, W, C]`` with the noise of its state ``[S]``."""
        random = generator(_NOISE_KEY, zlib.crc32(state.tobytes()))
        picture = corruptions.shot(picture, self._sensor.shot_noise, random)
        return corruptions.noise(picture, self._sensor.read_noise, random)


def on_the_ground(pictures: Pictures, depth: float) -> Pictures:
    """Paint stains on the ground behind what is seen, up to so many grey levels darker at 255.

    The ground of simulated scenes is white and their things have saturated colours: how much of a
    pixel is ground says its darkest channel.
    """
    first, *others = np.moveaxis(pictures, -1, 0)
    darkest = functools.reduce(np.minimum, others, first)  # 30 times as fast as min(axis=-1)
    ground: Pictures = darkest[..., None]
    painted: Pictures = corruptions.texture(ground, depth, generator(_NOISE_KEY))
    return pictures + (painted - ground)


def rates_of(names: tuple[str, ...]) -> Floats:
    """Return R ``[S, S]``: states ``[n, S]`` @ R are their rates, 0 of those that have none.

    A state's rate is the one with its name and ``_dot``.
    """
    rates = np.zeros((len(names), len(names)))
    for column, name in enumerate(names):
        if name + _RATE in names:
            rates[names.index(name + _RATE), column] = 1.0
    return rates


def _check_exposure(exposure_ms: float, kind: System, rates: Floats) -> None:
    step_ms = 1e3 * kind.step_s
    if exposure_ms > step_ms * (1 + 1e-9):
        raise UsageError(
            f"sensor.exposure_ms = {exposure_ms:g}; a picture of every control step of plant "
            f"{kind.name} is exposed for {step_ms:g} ms at most",
            key="sensor.exposure_ms",
        )
    if exposure_ms and not rates.any():
        raise UsageError(
            f"sensor.exposure_ms = {exposure_ms:g} blurs by the rates of states, called …{_RATE}; "
            f"plant {kind.name} has {', '.join(kind.state_names)}",
            key="sensor.exposure_ms",
        )
