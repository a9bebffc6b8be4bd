"""Devices may differ from those that everything was trained on in poles, light and camera noise;
pictures for training may vary in light and noise.

Controllers, teachers and the oracle's equations stay the nominal ones: nobody tells them.
"""

import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.schema import ConditionSettings, EncoderSettings, Settings
from hjepa_cli.core.arrays import Floats, Pixels
from hjepa_cli.core.plants.frames import FRAME_SHAPE
from hjepa_cli.core.plants.named import camera_of, plant
from hjepa_cli.core.plants.system import Camera, System

NOMINAL = {"light": 1.0, "camera_noise": 0.0, "pole_length": 1.0}
_NOISE_KEY = 0xCA3E
_VARIED_KEY = 0x11B7
_SPLITS = ("train", "test")


def altered(settings: Mapping[str, Any]) -> dict[str, float]:
    """Return the conditions that are not nominal, of settings as ``as_dict`` or a file has them."""
    conditions = settings.get("conditions", {})
    return {key: value for key, value in conditions.items() if value != NOMINAL.get(key)}


def actual_plant(name: str, conditions: ConditionSettings) -> System:
    """Return the plant of the devices.

    Raises:
        UsageError: longer poles of a plant that has none.
    """
    kind, scale = plant(name), conditions.pole_length
    return kind if scale == 1.0 else kind.with_pole_length(scale)


def actual_camera(settings: Settings) -> Camera:
    """Return the camera that looks at the devices of some settings."""
    conditions = settings.conditions
    camera = camera_of(actual_plant(settings.plant, conditions), settings.camera)
    if (conditions.light, conditions.camera_noise) == (1.0, 0.0):
        return camera
    return Disturbed(camera, conditions.light, conditions.camera_noise, settings.seed)


class Disturbed:
    """A camera works in another light, with noise of its own in every pixel.

    Values are multiplied by ``light`` and clipped at white; ``noise`` is a standard deviation in
    steps of 8-bit values. The noise is a function of the seed and of the states rendered together.
    It does not depend on which process renders them or when, but on who else is in the picture's
    batch: methods that send at other times do not share it.
    """

    def __init__(self, camera: Camera, light: float, noise: float, seed: int) -> None:
        self._camera, self._light, self._noise, self._seed = camera, light, noise, seed
        self.frame_shape = getattr(camera, "frame_shape", FRAME_SHAPE)

    def render(self, states: ArrayLike) -> Pixels:
        """Return frames ``[n, H, W, C]`` of states ``[n, S]``."""
        drawn = zlib.crc32(np.ascontiguousarray(states, np.float64).tobytes())
        random = generator(self._seed, _NOISE_KEY, drawn)
        return disturbed(self._camera.render(states), self._light, self._noise, random)

    def manifest(self) -> dict[str, Any]:
        """Return the camera's manifest with light and noise."""
        return self._camera.manifest() | {"light": self._light, "noise": self._noise}

    def sketch_px(self, state: ArrayLike) -> list[Floats]:
        """Return the camera's sketch."""
        return self._camera.sketch_px(state)


def disturbed(frames: Pixels, light: float, noise: float, random: np.random.Generator) -> Pixels:
    """Return ``frames`` of any shape with all values × ``light`` and white noise added, clipped."""
    values = np.float32(light) * frames.astype(np.float32)
    if noise:
        values += np.float32(noise) * random.standard_normal(values.shape, np.float32)
    seen: Pixels = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return seen


def vary(frames: Pixels, encoder: EncoderSettings, seed: int, split: str) -> Pixels:
    """Return pictures [N, T, H, W, 3], each trajectory in a light and noise of its own.

    The light is uniform in 1 ± ``encoder.light_spread``, the noise's standard deviation between 0
    and ``encoder.camera_noise``. Without both, ``frames`` themselves come back.
    """
    spread, most = encoder.light_spread, encoder.camera_noise
    if not (spread or most):
        return frames
    random = generator(seed, _VARIED_KEY, _SPLITS.index(split))
    varied = np.empty_like(frames)
    for before, after in zip(frames, varied, strict=True):
        light, noise = 1 + spread * random.uniform(-1, 1), most * random.uniform()
        after[:] = disturbed(before, light, noise, random)
    return varied
