"""What a model sees on trajectories like those it was trained on: the ground for closed-form fits.

The trajectories are drawn from the settings' seed, so that a fit is the same wherever it is made.
"""

import dataclasses
import functools
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from hjepa_cli.config.settings import Settings
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.datasets.trajectories import generate
from hjepa_cli.core.plants.frames import frames_seen
from hjepa_cli.core.plants.named import plant

if TYPE_CHECKING:
    from hjepa_cli.core.networks.model import Model

RENDER_BATCH = 256  # inputs of two frames rendered at a time: 12 MiB


@dataclasses.dataclass(frozen=True, eq=False)
class Typical:
    """Embedded trajectories of one split.

    Attributes:
        z: embeddings of k = 0 … T − 1 [N, T, D], float32, on the CPU.
        states: the states behind them [N, T, S].
        actions: forces ÷ force limit from each step to the next [N, T, F], of a device in a row.
    """

    z: Tensor
    states: Floats
    actions: Floats


@functools.lru_cache(maxsize=2)  # the splits of one model
def typical(model: "Model", settings: Settings, split: str) -> Typical:
    """Embed a whole split (``train`` or ``test``) of the settings."""
    drawn, kind = generate(settings, split), plant(model.plant_name)
    count, steps = drawn.applied_n.shape[:2]
    seen = frames_seen(np.arange(steps), model.frames)
    z = embed_states(model, drawn.states[:, seen].reshape(count * steps, *seen.shape[1:], -1))
    return Typical(
        z.reshape(count, steps, -1),
        drawn.states[:, 1:].astype(np.float64),
        drawn.applied_n.reshape(count, steps, -1).astype(np.float64) / kind.force_limit_n,
    )


def embed_states(model: "Model", seen: Floats) -> Tensor:
    """Embeddings [n, D] of what a camera shows of states [n, κ, S], the present one last."""
    camera = plant(model.plant_name).camera()
    parts = []
    for start in range(0, len(seen), RENDER_BATCH):
        part = seen[start : start + RENDER_BATCH]
        frames = camera.render(part.reshape(-1, part.shape[2]).astype(float))
        parts.append(model.encode(frames.reshape(*part.shape[:2], *frames.shape[1:])))
    return torch.cat(parts)
