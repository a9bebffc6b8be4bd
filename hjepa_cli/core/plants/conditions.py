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
from hjepa_cli.config.schema import ConditionSettings, EncoderSettings, Settings
from hjepa_cli.core.arrays import Floats, Pixels
from hjepa_cli.core.plants import corruptions, stress
from hjepa_cli.core.plants.corruptions import as_bytes
from hjepa_cli.core.plants.frames import FRAME_SHAPE, Camera
from hjepa_cli.core.plants.named import camera_of, plant
from hjepa_cli.core.plants.recorded import Recorded
from hjepa_cli.core.plants.stress import CONDITIONS, Condition, Parts
from hjepa_cli.core.plants.system import System
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
    if wear and isinstance(kind, Recorded):
        raise UsageError(f"condition {next(iter(wear))} is of forces; recordings are of pictures")
    kind = kind if scale == 1.0 else kind.with_pole_length(scale)
    return Worn(kind, wear) if wear else kind


def actual_camera(settings: Settings) -> Camera:
    """Return the camera that looks at the devices of some settings.

    Raises:
        UsageError: as of :func:`actual_plant`.
    """
    devices = actual_plant(settings.plant, settings.conditions)
    camera = camera_of(devices, settings.camera, settings.sensor)
    parts = pictured(settings.conditions)
    for one in parts:
        if one.of_colours and settings.camera.grey:
            raise UsageError(f"condition {one.name} is of colours; these pictures are grey")
    return Disturbed(camera, parts, settings.seed) if parts else camera


def pictured(conditions: ConditionSettings) -> dict[Condition, float]:
    """Return the conditions of pictures, in the order of effect.

    Raises:
        UsageError: one that there is not, or one that is a setting here and in ``stress`` too.
    """
    parts = stress.of_pictures(stress.own_of(conditions.stress))
    for key, severity in {"light": conditions.light, "noise": conditions.camera_noise}.items():
        one = CONDITIONS[key]
        if severity != one.nominal:
            if one in parts:
                raise UsageError(f"conditions.stress has {key}, which is a setting here too")
            parts[one] = severity
    return {one: parts[one] for one in CONDITIONS.values() if one in parts}


class Disturbed:
    """A camera works under conditions that it was not made for.

    What is random is a function of the seed and of the states rendered together. It does not depend
    on which process renders them or when, but on who else is in the picture's batch: methods that
    send at other times do not share it.
    """

    def __init__(self, camera: Camera, parts: Parts, seed: int) -> None:
        self._camera, self._parts, self._seed = camera, parts, seed
        self.frame_shape = getattr(camera, "frame_shape", FRAME_SHAPE)

    def render(self, states: ArrayLike) -> Pixels:
        """Return frames ``[n, H, W, C]`` of states ``[n, S]``, each of its own packet."""
        seen: Pixels = self.film(np.asarray(states)[:, None])[:, 0]
        return seen

    def film(self, states: ArrayLike) -> Pixels:
        """Return frames ``[m, κ, H, W, C]`` of the states ``[m, κ, S]`` of m packets."""
        states = np.ascontiguousarray(states, np.float64)
        frames = self._camera.render(states.reshape(-1, states.shape[-1]))
        return self._worse(frames.reshape(*states.shape[:2], *frames.shape[1:]), states)

    def retake(self, frames: Pixels) -> Pixels:
        """Return recorded frames ``[m, κ, H, W, C]`` of m packets as it would have seen them."""
        return self._worse(frames, frames)

    def _worse(self, frames: Pixels, shown: Floats | Pixels) -> Pixels:
        """Return frames ``[m, κ, H, W, C]`` under the conditions, at random by what they show."""
        drawn = zlib.crc32(np.ascontiguousarray(shown).tobytes())
        random = generator(self._seed, _NOISE_KEY, drawn)
        pictures = frames.astype(np.float32)
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
        pictures = corruptions.light(before.astype(np.float32), light, random)
        if noise:  # of width 0 it would be drawn all the same, and later trajectories be others
            pictures = corruptions.noise(pictures, noise, random)
        after[:] = as_bytes(pictures)
    return varied
