"""What training reads is what the closed loop sees: frames, states and labels of the same step.

The oracle is the camera itself: a picture belongs to a state if rendering the state gives it.
"""

import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.codecs.integers import Integers
from hjepa_cli.core.control.sensors import embedding_sensor
from hjepa_cli.core.datasets.dataset import Trajectories
from hjepa_cli.core.plants.named import Camera, plant
from hjepa_cli.core.training.batches import FrameWindows, Labels, TrajectoryBatch
from hjepa_cli.core.training.rendered import RenderedSplit, labels_of, standardisation_sample
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages.embedding_training import embed_all
from hjepa_cli.stages.inputs import CHUNK, embed, render

QUIET = Screen(quiet=True)
LIMIT_N = 20.0
COUNT, STEPS = 3, 9


@pytest.fixture(scope="module")
def recorded() -> Trajectories:
    """Random states, no two alike; both forces are functions of the state of their step."""
    spread = np.array([0.2, 0.5, 0.3, 2.0])
    states = np.random.default_rng(0).normal(size=(COUNT, STEPS + 1, 4)) * spread
    states = states.astype(np.float32)
    now = states[:, 1:]
    return Trajectories(states, applied_n=10 * now[..., 0], teacher_n=10 * now[..., 2])


@pytest.fixture(scope="module")
def split(recorded: Trajectories) -> RenderedSplit:
    return render(recorded, load_settings(), QUIET)


def pictures(states: np.ndarray) -> Tensor:
    """States [..., 4] → uint8 [..., 64, 128, 3]."""
    images = Camera("desktop").render(states.reshape(-1, 4))
    return torch.from_numpy(images).reshape(*states.shape[:-1], *images.shape[1:])


@pytest.mark.parametrize("every", [1, 2, 4])
def test_pairs_are_the_frame_before_and_the_frame_of_a_step(
    recorded: Trajectories, split: RenderedSplit, every: int
) -> None:
    k = np.arange(0, STEPS, every)
    before, now = recorded.states[:, k], recorded.states[:, k + 1]
    expected = pictures(np.stack([before, now], axis=2)).flatten(0, 1)
    assert torch.equal(split.seen(every), expected)
    assert not torch.equal(expected[:, 0], expected[:, 1])


@pytest.mark.parametrize("every", [1, 2, 4])
def test_mirrored_pairs_show_the_mirrored_states(
    recorded: Trajectories, split: RenderedSplit, every: int
) -> None:
    k = np.arange(0, STEPS, every)
    mirrored = -np.stack([recorded.states[:, k], recorded.states[:, k + 1]], axis=2)
    assert torch.equal(split.seen(every, mirrored=True), pictures(mirrored).flatten(0, 1))


@pytest.mark.parametrize("every", [1, 2, 4])
def test_states_and_labels_belong_to_the_current_frame(split: RenderedSplit, every: int) -> None:
    states, labels = split.states_at(every), split.labels_at(every)
    assert torch.equal(pictures(states.numpy()), split.seen(every)[:, 1])
    torch.testing.assert_close(labels * LIMIT_N, 10 * states[:, 2])
    torch.testing.assert_close(split.actions * LIMIT_N, 10 * split.states[..., 0])


def test_stored_frames_are_read_as_rendered_ones(
    recorded: Trajectories, split: RenderedSplit
) -> None:
    stored = Trajectories(
        recorded.states, recorded.applied_n, recorded.teacher_n, pictures(recorded.states).numpy()
    )
    assert torch.equal(render(stored, load_settings(), QUIET).seen(1), split.seen(1))


@pytest.mark.parametrize("mirror", [False, True])
def test_training_batches_hold_the_same_pairs(split: RenderedSplit, mirror: bool) -> None:
    windows = FrameWindows(split.frames, split.actions, window_frames=3, stride=4, mirror=mirror)
    batch = windows.draw(12, np.random.default_rng(1))
    plain, mirrored = split.seen(1), split.seen(1, mirrored=True)
    actions = split.actions.flatten()
    signs = set()
    for window, played in zip(batch.frames.unflatten(0, (12, 3)), batch.actions, strict=True):
        first = [
            (sign, i)
            for sign, known in ((1.0, plain), (-1.0, mirrored))
            for i in range(len(known))
            if torch.equal(known[i], window[0])
        ]
        ((sign, i),) = first  # no two pairs are alike
        known = plain if sign > 0 else mirrored
        assert torch.equal(known[i : i + 9 : 4], window)
        assert torch.equal(played.flatten(), sign * actions[i : i + 8])
        signs.add(sign)
    assert signs == ({1.0, -1.0} if mirror else {1.0})


def alike(one: Tensor, other: Tensor) -> bool:
    """Equal but for rounding: x in float32 plus a shift moves a value by one at times."""
    return bool((one.int() - other.int()).abs().max() <= 1)


def test_shifted_windows_are_what_the_camera_sees_elsewhere_on_the_track(
    recorded: Trajectories,
) -> None:
    """Against the camera: the same states, so many pixels to the side."""
    in_view = recorded.states * np.array([0.2, 1, 0.5, 1], np.float32)
    split = render(dataclasses.replace(recorded, states=in_view), load_settings(), QUIET)
    windows = FrameWindows(
        split.frames, split.actions, window_frames=3, stride=4, mirror=False, shift_px=2
    )
    batch = windows.draw(12, np.random.default_rng(1))
    pixel_m = plant("desktop").window_m[0] / 128
    seen = set()
    known = {}
    for shift_px in range(-2, 3):
        states = in_view.astype(float)
        states[..., 0] += shift_px * pixel_m
        pairs = np.stack([states[:, :-1], states[:, 1:]], axis=2).reshape(-1, 2, 4)
        known[shift_px] = pictures(pairs)
    actions = split.actions.flatten()
    for window, played in zip(batch.frames.unflatten(0, (12, 3)), batch.actions, strict=True):
        ((shift_px, i),) = [
            (shift_px, i)
            for shift_px, there in known.items()
            for i in range(len(there))
            if alike(there[i], window[0])
        ]
        assert alike(known[shift_px][i : i + 9 : 4], window)
        assert torch.equal(played.flatten(), actions[i : i + 8])
        seen.add(shift_px)
    assert len(seen) >= 4


@pytest.mark.parametrize("mirror", [False, True])
def test_labels_are_what_the_teacher_does_where_the_window_shows(
    recorded: Trajectories, mirror: bool
) -> None:
    """The state that a moved window shows is found through the camera, then the teacher asked."""
    in_view = recorded.states * np.array([0.2, 1, 0.5, 1], np.float32)
    split = render(dataclasses.replace(recorded, states=in_view), load_settings(), QUIET)
    kind = plant("desktop")

    def drawn(labels: Labels | None) -> TrajectoryBatch:
        windows = FrameWindows(
            *(split.frames, split.actions),
            window_frames=2,
            stride=3,
            mirror=mirror,
            shift_px=2,
            labels=labels,
        )
        return windows.draw(16, np.random.default_rng(2))

    batch, unlabelled = drawn(labels_of(split, kind, kind.teacher())), drawn(None)
    assert batch.labels is not None and unlabelled.labels is None
    assert torch.equal(batch.frames, unlabelled.frames), "labels draw nothing"
    seen = set()
    for window, told in zip(
        batch.frames.unflatten(0, (16, 2)), batch.labels.unflatten(0, (16, 2)), strict=True
    ):
        found = []
        for sign in (1, -1):
            for shift_px in range(-2, 3):
                states = sign * in_view.astype(float)
                states[..., 0] += shift_px * kind.window_m[0] / 128
                now = states[:, 1:].reshape(-1, 4)
                shown = pictures(now)
                found += [
                    (sign, shift_px, now[[i, i + 3]])
                    for i in range(len(now) - 3)
                    if alike(shown[i], window[0, -1]) and alike(shown[i + 3], window[1, -1])
                ]
        ((sign, shift_px, states),) = found
        np.testing.assert_allclose(told * LIMIT_N, kind.teacher()(states), atol=1e-4)
        seen.add((sign, shift_px))
    assert len({shift_px for _, shift_px in seen}) >= 4
    assert {sign for sign, _ in seen} == ({1, -1} if mirror else {1})


def test_shifted_copies_are_embedded_and_labelled_where_they_are(recorded: Trajectories) -> None:
    """An encoder that keeps the present picture shows what was embedded."""
    in_view = recorded.states * np.array([0.2, 1, 0.5, 1], np.float32)
    split = render(dataclasses.replace(recorded, states=in_view), load_settings(), QUIET)
    split = dataclasses.replace(
        split, labels=torch.from_numpy(plant("desktop").teacher()(in_view[:, 1:]) / LIMIT_N)
    )
    flags = {"device": "cpu", "hierarchy.shifted_copies": 3, "encoder.shift_px": 3}
    settings = load_settings(flags=flags | {"control.gains_n": []})  # labels are the teacher's

    class Last(nn.Module):
        def forward(self, frames: Tensor) -> Tensor:
            return frames[:, -1].flatten(1).float()

    seen = embed_all(Last(), split, settings, QUIET, flip=True)
    assert len(seen) == 2 * (1 + 3)
    shifts = set()
    for view, (data, labels) in enumerate(seen):
        sign = 1 if view < 4 else -1
        assert torch.equal(data.actions, sign * split.actions)
        for row in range(COUNT):
            shown = data.z[row].reshape(STEPS, 64, 128, 3)
            found = []
            for shift_px in range(-3, 4):
                states = sign * in_view[row, 1:].astype(float)
                states[:, 0] += shift_px * plant("desktop").window_m[0] / 128
                if alike(pictures(states), shown):
                    found.append((shift_px, states))
            ((shift_px, states),) = found
            expected = plant("desktop").teacher()(states) / LIMIT_N
            np.testing.assert_allclose(labels[row], expected, atol=1e-5)
            assert view % 4 or shift_px == 0  # the first view is the recording itself
            shifts.add(shift_px)
    assert len(shifts) >= 4


def test_the_closed_loop_encodes_the_same_pairs(
    recorded: Trajectories, split: RenderedSplit
) -> None:
    class Spy:
        camera, device, look = plant("desktop").camera(), "cpu", (1, 0)

        def encode(self, frames: np.ndarray) -> Tensor:
            self.shown = torch.from_numpy(frames)
            return torch.ones(len(frames), 4)

    spy = Spy()
    sense = embedding_sensor(spy, Integers(4, 8).send)  # type: ignore[arg-type]
    pairs = np.stack([recorded.states[:, :-1], recorded.states[:, 1:]], axis=2)
    sense(pairs.reshape(-1, 2, 4).astype(float))
    assert torch.equal(spy.shown, split.seen(1))


# ---- painted frames: value 0 is the time, value 1 the trajectory ---------------------------------


class Reader(nn.Module):
    """Embeds a pair as what its left column says: (previous time, current time, trajectory)."""

    def forward(self, frames: Tensor) -> Tensor:
        left = frames[:, :, 0, 0].float()
        return torch.stack([left[:, 0, 0], left[:, 1, 0], left[:, 1, 1]], dim=-1)


def painted(count: int, steps: int) -> RenderedSplit:
    """The left column is painted with time and trajectory, the right one with 100 + time."""
    frames = torch.zeros(count, steps + 1, 1, 2, 3, dtype=torch.uint8)
    frames[:, :, 0, :, 0] = torch.arange(steps + 1)[:, None]
    frames[:, :, 0, 1, 0] += 100
    frames[:, :, 0, :, 1] = torch.arange(count)[:, None, None]
    k = torch.arange(1.0, steps + 1).expand(count, -1)
    return RenderedSplit(frames, k[..., None].expand(-1, -1, 4), k, k / 2)


@pytest.mark.parametrize(("every", "mirrored"), [(1, False), (4, False), (4, True)])
def test_embeddings_keep_trajectories_and_steps_apart(every: int, mirrored: bool) -> None:
    count, steps = CHUNK + 3, 10
    done: list[int] = []
    z = embed(
        Reader(),
        painted(count, steps),
        load_settings(flags={"device": "cpu"}),
        every=every,
        mirrored=mirrored,
        advance=done.append,
    )
    k = torch.arange(0.0, steps, every) + 100 * mirrored
    rows = torch.arange(float(count))[:, None].expand(-1, len(k))
    expected = torch.stack([k.expand_as(rows), k.expand_as(rows) + 1, rows], dim=-1)
    assert torch.equal(z, expected)
    assert sum(done) == count


def test_mirror_images_come_with_negated_actions_and_labels() -> None:
    split = painted(4, 10)
    settings = load_settings(flags={"device": "cpu", "hierarchy.shifted_copies": 0})
    (plain, labels), (mirrored, mirrored_labels) = embed_all(
        Reader(), split, settings, QUIET, flip=True
    )
    assert torch.equal(mirrored.z[..., 0], plain.z[..., 0] + 100)
    assert torch.equal(plain.actions, split.actions) and torch.equal(labels, split.labels)
    assert torch.equal(mirrored.actions, -split.actions)
    assert torch.equal(mirrored_labels, -split.labels)


def test_the_standardisation_sample_crosses_no_trajectory() -> None:
    sample = standardisation_sample(painted(7, 10).frames, (1, 0), 1000)[:, :, 0, 0].long()
    assert torch.equal(sample[:, 1, 0], sample[:, 0, 0] + 1)
    assert torch.equal(sample[:, 1, 1], sample[:, 0, 1])
    assert len(sample) == 7 * 10
