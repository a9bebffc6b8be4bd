"""How devices may differ from those that everything was trained on: poles, light, camera noise.

Controllers, teachers and the oracle's equations stay the nominal ones: nobody tells them.
"""

import dataclasses
import zlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hjepa_cli.core.plant import cart_pole, plant
from hjepa_cli.core.seeding import generator
from hjepa_cli.core.system import Camera, Floats, System
from hjepa_cli.settings import Settings

_NOISE_KEY = 0xCA3E


def actual_plant(settings: Settings) -> System:
    """The plant of the devices.

    Raises:
        UsageError: longer poles of a plant that has none.
    """
    kind, scale = plant(settings.plant), settings.conditions.pole_length
    if scale == 1.0:
        return kind
    nominal = cart_pole(settings.plant)
    return dataclasses.replace(nominal, half_length_m=scale * nominal.half_length_m)


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
        values = self._light * self._camera.render(states).astype(np.float32)
        if self._noise:
            drawn = zlib.crc32(np.ascontiguousarray(states, np.float64).tobytes())
            random = generator(self._seed, _NOISE_KEY, drawn)
            values += self._noise * random.standard_normal(values.shape, np.float32)
        seen: NDArray[np.uint8] = np.clip(np.rint(values), 0, 255).astype(np.uint8)
        return seen

    def manifest(self) -> dict[str, Any]:
        """As of any camera."""
        return self._camera.manifest() | {"light": self._light, "noise": self._noise}

    def sketch_px(self, state: ArrayLike) -> list[Floats]:
        """As of any camera."""
        return self._camera.sketch_px(state)
