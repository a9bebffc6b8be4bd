"""Measure a model on recordings alone: errors of its forces after a packet, its embeddings.

No simulator is asked: a controller is left alone after one packet, as in
:mod:`hjepa_cli.core.evaluation.control_errors`, and its forces are compared with those that the
expert recorded meanwhile. That is no closed loop, since the pictures do not answer to the forces.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hjepa_cli.core import statistics
from hjepa_cli.core.arrays import Floats, Pixels, check_answer
from hjepa_cli.core.control.drivers import Driver
from hjepa_cli.core.control.sensors import retaken
from hjepa_cli.core.evaluation.bench import control_entry
from hjepa_cli.core.evaluation.control_errors import control_errors
from hjepa_cli.core.networks.model import Model
from hjepa_cli.core.networks.planning import Planner
from hjepa_cli.core.plants.frames import Camera, frames_seen

WITHIN = (0.02, 0.05, 0.1)  # of the force range


@dataclasses.dataclass(frozen=True, eq=False)
class Recorded:
    """R recorded trajectories of one length, each with W windows of ``horizon`` + 1 steps.

    Attributes:
        frames: uint8 [R · W, horizon + 2, H, W, C]; the first is the one before the packet's.
        actions: applied ones ÷ limit [R · W, horizon + 1, *A].
        expert: the expert's ÷ limit, the same shape.
        trajectories: R.
    """

    frames: Pixels
    actions: Floats
    expert: Floats
    trajectories: int

    @classmethod
    def cut(cls, frames: Pixels, actions: Floats, expert: Floats, horizon: int) -> "Recorded":
        """Cut trajectories [R, T + 1, …] into windows that follow each other."""
        count, steps = actions.shape[:2]
        starts = range(0, steps - horizon, horizon + 1)

        def windows(values: Any, length: int) -> Any:
            cut = np.stack([values[:, start : start + length] for start in starts], axis=1)
            return cut.reshape(count * len(starts), *cut.shape[2:])

        rows = horizon + 1
        return cls(windows(frames, rows + 1), windows(actions, rows), windows(expert, rows), count)

    @property
    def horizon(self) -> int:
        """Return how many steps after the packet a window ends."""
        return int(self.actions.shape[1]) - 1

    def by_trajectory(self, values: Floats) -> Floats:
        """Average [R · W, …] over the windows of each trajectory, which are not independent."""
        return np.asarray(values.reshape(self.trajectories, -1, *values.shape[1:]).mean(axis=1))


def entry_of(driver: Driver, recorded: Recorded, replicates: int, seed: int) -> dict[str, Any]:
    """Return what an offline ``eval --json`` says of a method: its NMAE, and how long it is small.

    ``replicates`` and ``seed`` are of the bootstrap over trajectories.
    """
    measured = [
        recorded.by_trajectory(
            control_errors(
                driver,
                recorded.frames,
                recorded.expert,
                1.0,
                recorded.horizon,
                every_packet=every_packet,
            )
        )
        for every_packet in (False, True)
    ]
    alone, every = measured
    said = control_entry(alone, every, replicates, seed)
    return {
        **said,
        "steps_within": {f"{most:g}": steps_within(said["nmae"], most) for most in WITHIN},
        "bits_per_transmission": driver.bits_per_transmission,
    }


def steps_within(nmae: Floats | list[float], most: float) -> int:
    """Return how many steps from a packet on the error never exceeds ``most``; 0: not even once."""
    above = np.asarray(nmae) > most
    return int(np.argmax(above)) if above.any() else len(above)


@torch.inference_mode()
def embedded(model: Model, frames: Pixels, camera: Camera) -> Tensor:
    """Embed all steps of windows [N, K + 1, H, W, C], under a camera's conditions: [N, K, D]."""
    seen = frames_seen(np.arange(frames.shape[1] - 1), model.look)
    return torch.stack([model.encode(retaken(camera, window[seen])) for window in frames])


@torch.inference_mode()
def latent_errors(
    planner: Planner, z: Tensor, recorded: Recorded, replicates: int, seed: int
) -> Mapping[str, Any]:
    """Compare what a planner predicts under the recorded actions with the embeddings seen then.

    Args:
        planner: moves embeddings on, a stride at a time.
        z: embeddings of the windows [N, K, D].
        recorded: the windows.
        replicates, seed: of the bootstrap.

    Returns:
        ``steps`` after the packet, and for each 1 − cos of prediction and truth: ``error`` and
        ``error_ci95``, and ``still``, that of a prediction that nothing changes.
    """
    steps = np.arange(planner.stride, z.shape[1], planner.stride)
    ages = np.full(len(z), planner.stride)
    forces = torch.from_numpy(np.asarray(recorded.actions)).float()
    now, missed, still = z[:, 0], [], []
    for step in steps:
        moved = planner.follow(now, forces[:, step - planner.stride : step], ages)
        check_answer(moved, now.shape, "follow(…)", Tensor)
        now = moved.float().cpu()
        truth = z[:, step]
        missed.append(1 - torch.cosine_similarity(now, truth, dim=-1))
        still.append(1 - torch.cosine_similarity(z[:, 0], truth, dim=-1))
    if not missed:
        return {"steps": [], "error": [], "error_ci95": [], "still": []}
    errors = recorded.by_trajectory(torch.stack(missed, dim=1).double().numpy())
    weights = statistics.bootstrap_weights(len(errors), replicates, seed)
    return {
        "steps": steps.tolist(),
        "error": errors.mean(axis=0).tolist(),
        "error_ci95": statistics.mean_interval(errors, weights).T.tolist(),
        "still": torch.stack(still, dim=1).mean(dim=0).tolist(),
    }
