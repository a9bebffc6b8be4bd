"""Sensors: a device that sends at every step looks at pictures that it has seen before."""

import itertools
from collections import Counter
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import ArrayLike

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.arrays import Pixels
from hjepa_cli.core.control.sensors import camera_sensor, embedding_sensor
from hjepa_cli.core.networks.model import Model, build_modules
from hjepa_cli.core.plants.named import plant
from hjepa_cli.stages.train_encoder import describe_architecture

CAMERA = plant("desktop").camera()


class Counting:
    """A camera counts how often it takes each picture."""

    def __init__(self) -> None:
        self.taken: Counter[bytes] = Counter()

    def render(self, states: ArrayLike) -> Pixels:
        self.taken.update(row.tobytes() for row in np.asarray(states))
        return CAMERA.render(states)


class Filming(Counting):
    """A camera makes the pictures of a packet together."""

    def film(self, states: ArrayLike) -> Pixels:
        states = np.asarray(states)
        frames = self.render(states.reshape(-1, states.shape[-1]))
        return frames.reshape(*states.shape[:2], *frames.shape[1:])


def untrained(frame_spacing: str = "even", **encoder: Any) -> Model:
    options = load_settings(flags={f"encoder.{key}": value for key, value in encoder.items()})
    architecture = describe_architecture(options) | {"kind": "hierarchy", "embedding": 8}
    architecture |= {"hidden": 8, "actor_hidden": 8, "actor_dropout": 0.0, "h": 4, "m": 2, "l": 1}
    architecture["frame_spacing"] = frame_spacing
    torch.manual_seed(0)
    modules = build_modules(architecture)
    metadata = {"architecture": architecture, "plant": "desktop", "settings": options.as_dict()}
    return Model(modules, metadata, "", "cpu")


def windows(devices: int = 3, steps: int = 8) -> list[np.ndarray]:
    """Devices send at every step; the first states that they remember are copies."""
    walk = np.cumsum(np.random.default_rng(0).normal(size=(devices, steps, 4)), axis=1) * 0.02
    walk = np.concatenate([np.repeat(walk[:, :1], 15, axis=1), walk], axis=1)
    return [walk[:, k : k + 16] for k in range(steps)]


@pytest.mark.parametrize("frame_input", ["difference", "pair"])
@pytest.mark.parametrize("photometric", ["affine", "gain", "none"])
@pytest.mark.parametrize(
    ("spacing", "frames", "frame_gap"), [("even", 4, 1), ("square", 4, 1), ("even", 2, 5)]
)
def test_embeddings_are_those_of_all_pictures_anew(
    frame_input: str, photometric: str, spacing: str, frames: int, frame_gap: int
) -> None:
    model = untrained(
        spacing, frame_input=frame_input, photometric=photometric, frames=frames,
        frame_gap=frame_gap,
    )  # fmt: skip
    sense, look = embedding_sensor(model), camera_sensor(model)
    for seen in windows():
        assert torch.allclose(sense(seen), model.encode(look(seen)), atol=1e-5)


@pytest.mark.parametrize(("spacing", "seen_again"), [("even", 4), ("square", 10)])
def test_pictures_are_taken_once(spacing: str, seen_again: int) -> None:
    camera = Counting()
    sense = embedding_sensor(untrained(spacing), camera=camera)
    for seen in windows():
        sense(seen)
    # The first look is forgotten: who sends now and then never looks at a picture again. The
    # second one is at all that is seen again later.
    counts = Counter(camera.taken.values())
    assert sum(camera.taken.values()) == 3 * (4 + seen_again + 6) and counts[1] == 3 * 7


def test_other_devices_are_looked_at_anew() -> None:
    model = untrained()
    sense, look = embedding_sensor(model), camera_sensor(model)
    several, few = windows(), windows(devices=2)
    for seen in itertools.chain(several[:4], few[4:6], several[6:], [several[7]]):
        assert torch.allclose(sense(seen), model.encode(look(seen)), atol=1e-5)


def test_a_camera_that_films_makes_the_pictures_of_each_packet_anew() -> None:
    camera = Filming()
    sense = embedding_sensor(untrained(), camera=camera)
    for seen in windows():
        sense(seen)
    assert sum(camera.taken.values()) == 3 * 4 * 8
