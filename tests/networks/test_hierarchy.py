"""Alignment of the levels, proven on integer-valued fake embeddings for many (h, m, l).

A fake embedding of step k is the pair (trajectory, k); a fake action is the number of its step.
Whatever is predicted must carry the step it claims to be for, and must have been given exactly
the actions that lie between, in order.
"""

import itertools

import numpy as np
import pytest
import torch
from torch import Tensor

from hjepa_cli.core.networks.encoder import normalise
from hjepa_cli.core.networks.hierarchy import Strides, fill_gap, plan_stride, rollout
from hjepa_cli.core.training import levels
from hjepa_cli.core.training.batches import FrameWindows, stride_actions, window_indices
from hjepa_cli.core.training.levels import EmbeddedTrajectories
from hjepa_cli.core.training.losses import rollout_loss
from hjepa_cli.errors import UsageError

NESTED = [
    (h, m, l) for h, m, l in itertools.product(range(1, 25), repeat=3) if h % m == 0 and m % l == 0
]


class Clock:
    """A predictor of fake embeddings that checks what it is given and moves time by its stride."""

    def __init__(self, stride: int, *, exact_actions: bool = True) -> None:
        self.stride, self.exact, self.calls = stride, exact_actions, 0

    def __call__(
        self, z: Tensor, actions: Tensor, waypoint: Tensor | None = None, remaining: int = 1
    ) -> Tensor:
        self.calls += 1
        now = z[:, 1]
        assert actions.shape == (len(z), self.stride)
        if self.exact:
            expected = now[:, None] + torch.arange(self.stride)
            assert torch.equal(actions, expected), (actions, expected)
        if waypoint is not None:
            assert torch.equal(waypoint[:, 0], z[:, 0])
            assert torch.equal(waypoint[:, 1], now + remaining * self.stride)
        return z + torch.tensor([0.0, float(self.stride)])


def fake(trajectories: int, steps: int) -> EmbeddedTrajectories:
    k = torch.arange(steps, dtype=torch.float32)
    rows = torch.arange(trajectories, dtype=torch.float32)
    z = torch.stack([rows[:, None].expand(-1, steps), k[None].expand(trajectories, -1)], dim=-1)
    return EmbeddedTrajectories(z, k[None].expand(trajectories, -1).contiguous())


@pytest.mark.parametrize(("h", "m", "l"), NESTED)
def test_plan_stride_is_aligned(h: int, m: int, l: int) -> None:
    z = torch.stack([torch.arange(3.0), torch.tensor([0.0, 40.0, 7.0])], dim=1)
    coarse = Clock(h, exact_actions=False)
    actions, embeddings, z_next = plan_stride(
        lambda state: state[:, 1],  # the fake actor plays the number of the step it believes in
        coarse,
        Clock(m, exact_actions=False),
        Clock(l, exact_actions=False),
        z,
        Strides(h, m, l),
        recompute_waypoint=True,
    )
    fine_steps = z[:, 1:] + torch.arange(0, h, l)
    assert torch.equal(embeddings[..., 1], fine_steps)
    assert torch.equal(embeddings[..., 0], z[:, :1].expand(-1, h // l))
    assert torch.equal(actions, fine_steps.repeat_interleave(l, dim=1))  # held off the finest grid
    assert torch.equal(z_next, z + torch.tensor([0.0, float(h)]))
    assert coarse.calls == 3


def test_anchor_is_recomputed_with_the_played_actions() -> None:
    seen: list[Tensor] = []
    expected: list[Tensor] = []

    def coarse(
        z: Tensor, actions: Tensor, waypoint: Tensor | None = None, remaining: int = 1
    ) -> Tensor:
        seen.append(actions)
        return z + torch.tensor([0.0, 4.0])

    def medium(
        z: Tensor, actions: Tensor, waypoint: Tensor | None = None, remaining: int = 1
    ) -> Tensor:
        expected.append(actions)
        return z + torch.tensor([0.0, 2.0])

    z = torch.tensor([[0.0, 8.0]])
    held, answered = torch.full((1, 4), 8.0), torch.tensor([[8.0, 9.0, 10.0, 11.0]])
    for recompute, plays in ((True, [held, answered, answered]), (False, [held])):
        seen.clear()
        expected.clear()
        played, _, _ = plan_stride(
            lambda state: state[:, 1],
            coarse,
            medium,
            Clock(1, exact_actions=False),
            z,
            Strides(4, 2, 1),
            recompute_waypoint=recompute,
        )
        assert torch.equal(played, answered)
        assert torch.equal(torch.cat(seen), torch.cat(plays))
        assert torch.equal(torch.cat(expected), torch.cat(plays[:2])[:, :2])


def test_the_medium_level_starts_from_the_action_of_its_own_step() -> None:
    """Spec: P^M([z_b, z_{a+h}], u_b); in the second pass it knows what was played from b on."""
    seen: list[Tensor] = []

    def medium(
        z: Tensor, actions: Tensor, waypoint: Tensor | None = None, remaining: int = 1
    ) -> Tensor:
        seen.append(actions)
        return z + torch.tensor([0.0, 2.0])

    for recompute in (False, True):
        seen.clear()
        plan_stride(
            lambda state: state[:, 1],
            Clock(8, exact_actions=False),
            medium,
            Clock(1, exact_actions=False),
            torch.tensor([[0.0, 0.0]]),
            Strides(8, 2, 1),
            recompute_waypoint=recompute,
        )
        first, again = [[0, 0], [2, 2], [4, 4]], [[0, 1], [2, 3], [4, 5]]
        assert [actions[0].tolist() for actions in seen] == first + again * recompute


def test_planning_again_shrinks_the_error_of_a_held_action() -> None:
    """Scalar plant z' = g z + u under u = -c z, P^H exact, P^M sure that c drives to the waypoint:
    the waypoint of a held action leads it astray, and planning again cuts that by c / (g - c)."""
    g, c = 1.2, 0.3

    def coarse(
        z: Tensor, actions: Tensor, waypoint: Tensor | None = None, remaining: int = 1
    ) -> Tensor:
        for action in actions.T:
            z = g * z + action[:, None]
        return z

    def medium(
        z: Tensor, actions: Tensor, waypoint: Tensor | None = None, remaining: int = 1
    ) -> Tensor:
        assert waypoint is not None
        return waypoint / (g - c)

    z, errors = torch.tensor([[1.0]]), []
    for recompute in (False, True):
        played, _, z_next = plan_stride(
            lambda state: -c * state[:, 0],
            coarse,
            medium,
            coarse,
            z,
            Strides(2, 1, 1),
            recompute_waypoint=recompute,
        )
        errors.append(float(played[0, 1]) + c * (g - c))
        assert torch.equal(z_next, coarse(z, played if recompute else played[:, :1].expand(-1, 2)))
    assert errors[1] == pytest.approx(-c / (g - c) * errors[0], rel=1e-4)


@pytest.mark.parametrize(("h", "m", "l"), [s for s in NESTED if s[0] <= 12])
def test_training_gaps_are_aligned(h: int, m: int, l: int, monkeypatch: pytest.MonkeyPatch) -> None:
    data, generator = fake(6, 50), np.random.default_rng(0)
    compared: list[tuple[Tensor, Tensor]] = []

    def compare(predicted: Tensor, target: Tensor) -> Tensor:
        compared.append((predicted, target))
        return predicted.sum()

    monkeypatch.setattr(levels, "cosine_loss", compare)
    common = {"horizon_steps": 30, "trajectories": 5, "generator": generator}
    levels.medium_loss(Clock(m), Clock(h), data, h, m, **common)
    levels.low_loss(Clock(l), Clock(m), Clock(h), data, h, m, l, **common)
    for predicted, target in compared:
        assert torch.equal(predicted, target)
    assert compared[0][0].shape[1] == h // m - 1
    assert compared[1][0].shape[1] == m // l - 1


@pytest.mark.parametrize("stride", [1, 2, 3, 4, 5, 7, 12, 24])
def test_rollouts_reach_their_targets(stride: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The golden index test of the target list k + h … k + K_p (paper §III-A)."""
    from hjepa_cli.core.training import losses

    data, generator = fake(4, 100), np.random.default_rng(1)
    frames = data.window_frames(stride)
    assert (frames - 1) * stride <= 99 < frames * stride
    rows, k, actions = data.windows(4, frames, stride, generator)
    z = data.z[rows, k]
    reached: list[Tensor] = []

    def compare(predicted: Tensor, target: Tensor) -> Tensor:
        assert torch.equal(predicted, target)
        reached.append(target[..., 1])
        return torch.arange(float(target.shape[1])).expand(len(target), -1)

    monkeypatch.setattr(losses, "cosine_similarity", compare)
    starts = torch.tensor([0, 1, frames // 2]).unique()
    horizon = max(80 // stride, 1)
    loss = rollout_loss(Clock(stride), z, z, actions, starts, horizon)
    running = [int((starts + step < frames).sum()) for step in range(1, horizon + 1)]
    running = [count for count in running if count]
    ((targets,),) = [reached]
    by_step = targets.split(running, dim=1)
    first = torch.stack([step[:, 0] for step in by_step], dim=1)
    # Every step weighs the same, however many starts are still running.
    places = np.split(np.arange(sum(running)), np.cumsum(running)[:-1])
    assert loss.item() == pytest.approx(1 - np.mean([place.mean() for place in places]))
    expected = k[:, :1] + stride * torch.arange(1, min(horizon, frames - 1) + 1)
    assert torch.equal(first, expected.float())


def test_rollout_and_fill_gap_keep_their_ends() -> None:
    data = fake(2, 30)
    actions = data.actions[:, :24].unflatten(1, (3, 8))
    waypoints = rollout(Clock(8), data.z[:, 0], actions)
    assert torch.equal(waypoints, data.z[:, ::8][:, :4])
    filled = fill_gap(
        Clock(2), waypoints[:, 0], waypoints[:, 1], actions[:, 0].unflatten(1, (4, 2))
    )
    assert torch.equal(filled, data.z[:, 0:9:2])


def test_windows_stay_inside_and_actions_follow_frames() -> None:
    generator = np.random.default_rng(2)
    for frames, stride in ((25, 4), (100, 1), (2, 99), (8, 13)):
        k = window_indices(100, frames, stride, generator, 200)
        assert k.min() >= 0 and k.max() <= 99
        assert (np.diff(k, axis=1) == stride).all()
        actions = torch.arange(100.0).expand(200, -1)
        picked = stride_actions(actions, torch.from_numpy(k), stride)
        assert torch.equal(picked[..., 0], torch.from_numpy(k[:, :-1]).float())
        assert torch.equal(picked[..., -1] + 1, torch.from_numpy(k[:, 1:]).float())


def test_frame_windows_pair_each_frame_with_its_predecessor_and_mirror_both() -> None:
    count, steps, width = 5, 20, 4
    frames = torch.zeros(count, steps + 1, 1, width, 3, dtype=torch.uint8)
    frames[:, :, 0, 0, 0] = torch.arange(steps + 1)  # time is painted at the left edge …
    frames[:, :, 0, 1, 0] = torch.arange(count)[:, None]
    actions = torch.arange(1.0, steps + 1).expand(count, -1)
    windows = FrameWindows(frames, actions, window_frames=5, stride=4, mirror=True)
    batch = windows.draw(40, np.random.default_rng(3))
    pairs = batch.frames.unflatten(0, (40, 5))
    flipped = batch.actions[:, 0, 0] < 0
    assert 5 < int(flipped.sum()) < 35
    left, right = pairs[~flipped][..., 0, 0, 0], pairs[flipped][..., 0, -1, 0]
    for painted, sign in ((left, 1.0), (right, -1.0)):  # … and at the right edge when mirrored
        previous, current = painted[..., 0].long(), painted[..., 1].long()
        assert torch.equal(current, previous + 1)
        chosen = flipped if sign < 0 else ~flipped
        # frame index current = k + 1, action u_k is painted as k + 1
        assert torch.equal(sign * batch.actions[chosen][..., 0], current[:, :-1].float())


@pytest.mark.parametrize(
    ("h", "m", "l", "valid"),
    [(4, 3, 1, "1, 2, 4"), (12, 6, 4, "1, 2, 3, 6"), (4, 8, 1, "1, 2, 4"), (4, 2, 0, "1, 2")],
)
def test_strides_that_do_not_nest_name_the_valid_ones(h: int, m: int, l: int, valid: str) -> None:
    with pytest.raises(UsageError, match=valid):
        Strides(h, m, l)


def test_normalised_embeddings_have_unit_mean_square() -> None:
    z = normalise(torch.randn(7, 256) * 3 + 1)
    torch.testing.assert_close(z.square().mean(-1), torch.ones(7))
