"""Closed-form fits take embeddings of trajectories like those that a model was trained on.

The trajectories are drawn from the settings' seed, so that a fit is the same wherever it is made.
"""

import dataclasses
import functools
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from hjepa_cli.config.schema import Settings
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.control.sensors import embedding_sensor
from hjepa_cli.core.datasets.trajectories import generate
from hjepa_cli.core.plants.frames import EVERY, frames_seen, remembers_from

if TYPE_CHECKING:
    from hjepa_cli.core.networks.model import Model


SAMPLED = 2000  # embeddings that fits without labels take


@dataclasses.dataclass(frozen=True, eq=False)
class EmbeddedSplit:
    """Holds embedded trajectories of one split.

    Attributes:
        z: embeddings of k = 0 … T − 1 [N, T, D], float32, on the CPU.
        states: the states behind them [N, T, S].
        actions: forces ÷ force limit from each step to the next [N, T, F], of a device in a row.
    """

    z: Tensor
    states: Floats
    actions: Floats


@functools.lru_cache(maxsize=2)  # the splits of one model
def embed_split(model: "Model", settings: Settings, split: str) -> EmbeddedSplit:
    """Embed a split (``train`` or ``test``) of the settings, from where devices remember enough."""
    drawn, kind, first = generate(settings, split), model.plant, remembers_from(model.look)
    count, steps = drawn.applied_n[:, first:].shape[:2]
    seen = frames_seen(first + np.arange(steps), EVERY)
    z = embed_states(model, drawn.states[:, seen].reshape(count * steps, *seen.shape[1:], -1))
    actions = drawn.applied_n[:, first:].reshape(count, steps, -1).astype(np.float64)
    return EmbeddedSplit(
        z.reshape(count, steps, -1),
        drawn.states[:, first + 1 :].astype(np.float64),
        actions / kind.force_limit_n,
    )


def sampled_embeddings(model: "Model", settings: Settings, split: str) -> Tensor:
    """Embed about :data:`SAMPLED` pictures of a split of the settings, evenly spaced: [n, D]."""
    return embed_states(model, sampled_states(model, settings, split))


def sampled_states(model: "Model", settings: Settings, split: str) -> Floats:
    """Return what devices remember at about :data:`SAMPLED` steps of a split: [n, 16, S]."""
    states, first = generate(settings, split).states, remembers_from(model.look)
    shown = states[:, frames_seen(np.arange(first, states.shape[1] - 1), EVERY)]
    shown = shown.reshape(-1, *shown.shape[2:])
    return shown[:: max(1, len(shown) // SAMPLED)]


def embed_states(model: "Model", seen: Floats) -> Tensor:
    """Embed what the plant's camera shows of the last states [n, 16, S] of devices: [n, D]."""
    return embedding_sensor(model)(seen).cpu()
