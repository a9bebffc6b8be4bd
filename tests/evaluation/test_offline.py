"""What recordings say of a model, against values worked out apart from it."""

import numpy as np
import pytest
import torch

from hjepa_cli.core.evaluation.offline import Recorded, latent_errors, steps_within
from hjepa_cli.core.networks.health import action_r2, probe_r2


def recorded(trajectories=3, steps=11, horizon=4):
    random = np.random.default_rng(0)
    frames = random.integers(0, 256, (trajectories, steps + 1, 4, 5, 1), dtype=np.uint8)
    actions, expert = random.uniform(-1, 1, (2, trajectories, steps, 2))
    return Recorded.cut(frames, actions, expert, horizon), frames, actions, expert


def test_windows_follow_each_other_with_the_frame_before_their_packet():
    cut, frames, actions, expert = recorded()
    assert cut.frames.shape[:2] == (6, 6) and cut.horizon == 4  # two windows of 5 steps in 11
    for window in range(6):
        n, start = window // 2, 5 * (window % 2)
        assert np.array_equal(cut.frames[window], frames[n, start : start + 6])
        assert np.array_equal(cut.actions[window], actions[n, start : start + 5])
        assert np.array_equal(cut.expert[window], expert[n, start : start + 5])
    values = np.arange(6.0)
    assert cut.by_trajectory(values).tolist() == [0.5, 2.5, 4.5]


class Turning:
    """A planner whose world turns embeddings by the first action times its error."""

    def __init__(self, stride, share):
        self.stride, self._share = stride, share

    def follow(self, z, forces_n, ages):
        assert forces_n.shape[1] == self.stride and (ages == self.stride).all()
        return turned(z, self._share * forces_n[..., 0].sum(dim=1))


def turned(z, angle):
    sin, cos = torch.sin(angle), torch.cos(angle)
    return torch.stack([cos * z[:, 0] - sin * z[:, 1], sin * z[:, 0] + cos * z[:, 1]], dim=-1)


@pytest.mark.parametrize(("stride", "share"), [(1, 1.0), (2, 0.7)])
def test_latent_errors_are_the_angles_that_a_prediction_misses(stride, share):
    """Rotations have a closed form: 1 − cos of what is left of the angle."""
    cut, *_ = recorded()
    angle = np.concatenate([np.zeros((6, 1)), cut.actions[..., 0].cumsum(axis=1)], axis=1)[:, :5]
    start = torch.tensor([[1.0, 0.0]]).repeat(6, 1)
    z = torch.stack([turned(start, torch.from_numpy(angle[:, k]).float()) for k in range(5)], 1)
    found = latent_errors(Turning(stride, share), z, cut, 100, 0)
    steps = list(range(stride, 5, stride))
    assert found["steps"] == steps
    missed = [(1 - np.cos((1 - share) * angle[:, k])).mean() for k in steps]
    still = [(1 - np.cos(angle[:, k])).mean() for k in steps]
    assert found["error"] == pytest.approx(missed, abs=1e-6)
    assert found["still"] == pytest.approx(still, abs=1e-6)


def test_steps_within_counts_until_the_first_excess():
    assert steps_within([0.01, 0.02, 0.06, 0.01], 0.05) == 2
    assert steps_within([0.06, 0.0], 0.05) == 0
    assert steps_within([0.0, 0.0], 0.05) == 2


def test_action_r2_reads_what_embeddings_know():
    """z moves by the action: its mean over a stride is the difference of the ends, R² = 1."""
    random = torch.Generator().manual_seed(0)
    actions = torch.randn(20, 12, 2, generator=random)
    z = torch.cat([torch.zeros(20, 1, 2), actions.cumsum(dim=1)], dim=1)[:, :12]
    noise = torch.randn(20, 12, 5, generator=random)
    known = torch.cat([z, noise], dim=-1)
    assert action_r2(known[:15], actions[:15], known[15:], actions[15:], 3) > 0.999
    assert action_r2(noise[:15], actions[:15], noise[15:], actions[15:], 3) < 0.1
    assert action_r2(known, 0 * actions, known, 0 * actions, 3) is None


def test_a_state_that_stands_still_has_no_r2_and_no_states_have_no_probe():
    z = torch.randn(50, 4, generator=torch.Generator().manual_seed(0))
    states = torch.stack([z[:, 0], torch.ones(50)], dim=1)
    found = probe_r2(z, states, z, states, ["moves", "still"])
    assert found["moves"] > 0.99 and found["still"] is None
    assert probe_r2(z, states[:, :0], z, states[:, :0], []) == {}
