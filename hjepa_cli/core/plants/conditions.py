"""How devices may differ from those that everything was trained on: poles, light, camera noise;
and pictures for training in which light and noise vary.

Controllers, teachers and the oracle's equations stay the nominal ones: nobody tells them.
"""

import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.settings import Settings
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.plants.system import Camera, System

NOMINAL = {"light": 1.0, "camera_noise": 0.0, "pole_length": 1.0}
_NOISE_KEY = 0xCA3E
_VARIED_KEY = 0x11B7
_SPLITS = ("train", "test")


def altered(settings: Mapping[str, Any]) -> dict[str, float]:
    """The conditions that are not nominal, of settings as ``as_dict`` gives them or a file holds
    them."""
    conditions = settings.get("conditions", {})
    return {key: value for key, value in conditions.items() if value != NOMINAL.get(key)}


def actual_plant(settings: Settings) -> System:
    """The plant of the devices.

    Raises:
        UsageError: longer poles of a plant that has none.
    """
    kind, scale = plant(settings.plant), settings.conditions.pole_length
    if scale == 1.0:
        return kind
    return kind.with_pole_length(scale)


def actual_camera(settings: Settings) -> Camera:
    """The camera that looks at them."""
    camera, conditions = actual_plant(settings).camera(), settings.conditions
    if (conditions.light, conditions.camera_noise) == (1.0, 0.0):
        return camera
    return Disturbed(camera, conditions.light, conditions.camera_noise, settings.seed)


class Disturbed:
    """A camera in another light, with noise of its own in every pixel.

    Args:
        camera: what it would show.
        light: factor on all values; clipped at white.
        noise: standard deviation in steps of 8-bit values.
        seed: of the noise, which is a function of the states rendered together besides. It does not
            depend on which process renders them or when, but on who else is in the picture's batch:
            methods that send at other times do not share it.
    """

    def __init__(self, camera: Camera, light: float, noise: float, seed: int) -> None:
        self._camera, self._light, self._noise, self._seed = camera, light, noise, seed

    def render(self, states: ArrayLike) -> NDArray[np.uint8]:
        """States ``[n, S]`` → RGB frames ``[n, 64, 128, 3]``."""
        drawn = zlib.crc32(np.ascontiguousarray(states, np.float64).tobytes())
        random = generator(self._seed, _NOISE_KEY, drawn)
        return disturbed(self._camera.render(states), self._light, self._noise, random)

    def manifest(self) -> dict[str, Any]:
        """As of any camera."""
        return self._camera.manifest() | {"light": self._light, "noise": self._noise}

    def sketch_px(self, state: ArrayLike) -> list[Floats]:
        """As of any camera."""
        return self._camera.sketch_px(state)


def disturbed(
    frames: NDArray[np.uint8], light: float, noise: float, random: np.random.Generator
) -> NDArray[np.uint8]:
    """``frames`` of any shape with all values × ``light`` and white noise added, clipped.

    ``noise`` is its standard deviation in steps of 8-bit values.
    """
    values = np.float32(light) * frames.astype(np.float32)
    if noise:
        values += np.float32(noise) * random.standard_normal(values.shape, np.float32)
    seen: NDArray[np.uint8] = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return seen


def vary(frames: NDArray[np.uint8], settings: Settings, split: str) -> NDArray[np.uint8]:
    """Pictures [N, T, H, W, 3] of ``split``, each trajectory in a light and noise of its own.

    The light is uniform in 1 ± ``encoder.light_spread``, the noise's standard deviation between 0
    and ``encoder.camera_noise``. Without both, ``frames`` themselves come back.
    """
    spread, most = settings.encoder.light_spread, settings.encoder.camera_noise
    if not (spread or most):
        return frames
    random = generator(settings.seed, _VARIED_KEY, _SPLITS.index(split))
    varied = np.empty_like(frames)
    for before, after in zip(frames, varied, strict=True):
        light, noise = 1 + spread * random.uniform(-1, 1), most * random.uniform()
        after[:] = disturbed(before, light, noise, random)
    return varied
