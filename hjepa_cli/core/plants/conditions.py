"""Devices may differ from those that everything was trained on in poles, light and camera noise,
and in all that :mod:`hjepa_cli.core.plants.stress` names; pictures for training may vary in light
and noise.

Controllers, teachers and the oracle's equations stay the nominal ones: nobody tells them.
"""

import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.schema import ConditionSettings, EncoderSettings
from hjepa_cli.core.arrays import Floats, Pixels
from hjepa_cli.core.plants import stress
from hjepa_cli.core.plants.corruptions import as_bytes
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.plants.stress import CONDITIONS, Parts
from hjepa_cli.core.plants.system import Camera, System
from hjepa_cli.core.plants.worn import Worn
from hjepa_cli.errors import UsageError

NOMINAL = {"light": 1.0, "camera_noise": 0.0, "pole_length": 1.0, "stress": ""}
_NOISE_KEY = 0xCA3E
_VARIED_KEY = 0x11B7
_SPLITS = ("train", "test")


def altered(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the conditions that are not nominal, of settings as ``as_dict`` or a file has them."""
    conditions = settings.get("conditions", {})
    return {key: value for key, value in conditions.items() if value != NOMINAL.get(key)}


def actual_plant(name: str, conditions: ConditionSettings) -> System:
    """Return the plant of the devices.

    Raises:
        UsageError: longer poles of a plant that has none, or conditions that there are not.
    """
    kind, scale = plant(name), conditions.pole_length
    wear = stress.of_actuators(stress.own_of(conditions.stress))
    kind = kind if scale == 1.0 else kind.with_pole_length(scale)
    return Worn(kind, wear) if wear else kind


def actual_camera(name: str, conditions: ConditionSettings, seed: int) -> Camera:
    """Return the camera that looks at them.

    Raises:
        UsageError: as of :func:`actual_plant`.
    """
    camera = actual_plant(name, conditions).camera()
    own = {"light": conditions.light, "noise": conditions.camera_noise}
    parts = stress.of_pictures(stress.own_of(conditions.stress))
    for key, severity in own.items():
        one = CONDITIONS[key]
        if severity != one.nominal:
            if one in parts:
                raise UsageError(f"conditions.stress has {key}, which is a setting here too")
            parts[one] = severity
    if not parts:
        return camera
    return Disturbed(camera, {one: parts[one] for one in CONDITIONS.values() if one in parts}, seed)


class Disturbed:
    """A camera works under conditions that it was not made for.

    What is random is a function of the seed and of the states rendered together. It does not depend
    on which process renders them or when, but on who else is in the picture's batch: methods that
    send at other times do not share it.
    """

    def __init__(self, camera: Camera, parts: Parts, seed: int) -> None:
        self._camera, self._parts, self._seed = camera, parts, seed

    def render(self, states: ArrayLike) -> Pixels:
        """Return RGB frames ``[n, 64, 128, 3]`` of states ``[n, S]``, each of its own packet."""
        seen: Pixels = self.film(np.asarray(states)[:, None])[:, 0]
        return seen

    def film(self, states: ArrayLike) -> Pixels:
        """Return RGB frames ``[m, κ, 64, 128, 3]`` of the states ``[m, κ, S]`` of m packets."""
        states = np.ascontiguousarray(states, np.float64)
        drawn = zlib.crc32(states.tobytes())
        random = generator(self._seed, _NOISE_KEY, drawn)
        frames = self._camera.render(states.reshape(-1, states.shape[-1]))
        pictures = frames.reshape(*states.shape[:2], *frames.shape[1:]).astype(np.float32)
        for condition, severity in self._parts.items():
            assert condition.apply is not None, condition
            pictures = condition.apply(pictures, severity, random)
        return as_bytes(pictures)

    def manifest(self) -> dict[str, Any]:
        """Return the camera's manifest with the conditions."""
        return self._camera.manifest() | {"conditions": stress.written(self._parts)}

    def sketch_px(self, state: ArrayLike) -> list[Floats]:
        """Return the camera's sketch."""
        return self._camera.sketch_px(state)


def disturbed(frames: Pixels, light: float, noise: float, random: np.random.Generator) -> Pixels:
    """Return ``frames`` of any shape with all values × ``light`` and white noise added, clipped."""
    values = np.float32(light) * frames.astype(np.float32)
    if noise:
        values += np.float32(noise) * random.standard_normal(values.shape, np.float32)
    return as_bytes(values)


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
