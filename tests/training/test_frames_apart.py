"""Four frames, next to each other or further apart, from training to the closed loop."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from hjepa_cli.config.checks import check_settings
from hjepa_cli.config.schema import Settings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.embedded_split import embed_split
from hjepa_cli.core.evaluation.protocol import Point
from hjepa_cli.core.evaluation.simulator import Block, Simulator
from hjepa_cli.core.networks.model import Model
from hjepa_cli.core.training.batches import FrameWindows, TrajectoryBatch
from hjepa_cli.core.training.hardening import Hardening
from hjepa_cli.errors import UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import collect, train_encoder, train_hierarchy
from hjepa_cli.stages.inputs import embed, open_dataset, render
from hjepa_cli.storage.checkpoints import load_checkpoint

QUIET = Screen(quiet=True)
TINY = {
    "control.gains_n": [], "augment.steps": 3,
    "collect.trajectories": 3, "collect.test_trajectories": 2, "collect.clean_trajectories": 2,
    "collect.steps": 30, "collect.clean_steps": 12, "protocol.horizon": 10,
    "encoder.embedding": 16, "encoder.hidden": 16, "actor.hidden": 16, "encoder.steps": 3,
    "encoder.batch_trajectories": 2, "encoder.batch_frames": 4, "encoder.gate": False,
    "actor.epochs": 1, "actor.batch": 40, "hierarchy.rollout_steps": 8,
    "hierarchy.batch_trajectories": 2, "hierarchy.coarse_steps": 2, "hierarchy.flat_steps": 2,
    "hierarchy.medium_steps": 2, "hierarchy.low_steps": 2,
    "encoder.frames": 4, "encoder.frame_gap": 4, "encoder.photometric": "affine",
    "augment.strength": 1.0, "protocol.warmup_steps": 0, "protocol.steps": 30,
    "protocol.curve_devices": 2, "protocol.bracket_devices": 2, "protocol.payload": "float32",
    "protocol.false_alarm": 0.1,
}  # fmt: skip


def train(settings: Settings, root: Path) -> Model:
    """Collect, train and load a model; data, encoder and model lie below ``root``."""
    collect.run(settings, QUIET, out=root / "data")
    train_encoder.run(settings, QUIET, dataset=root / "data", out=root / "encoder")
    train_hierarchy.run(
        settings, QUIET, dataset=root / "data", encoder=str(root / "encoder"), out=root / "model"
    )
    return Model.load(root / "model" / "model.safetensors")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("apart")
    train(load_settings(flags=TINY), root)
    return root


def test_training_and_devices_see_the_same_frames(trained: Path) -> None:
    """Frames by the dataset's index, and by what a device remembers, give the same embeddings."""
    settings = load_settings(flags=TINY)
    model = Model.load(trained / "model" / "model.safetensors")
    assert model.look == (12, 8, 4, 0)
    assert {"frames": 4, "frame_gap": 4, "photometric": "affine"}.items() <= (
        model.architecture.items()
    )
    split = render(open_dataset(trained / "data", settings).split("train"), settings, QUIET)
    by_training = embed(model.networks["encoder"], split, settings)
    by_devices = embed_split(model, settings, "train").z
    # They begin where a device has seen four pictures: those of steps −1, 3, 7 and 11.
    torch.testing.assert_close(by_training[:, 11:], by_devices, atol=1e-4, rtol=1e-4)
    other = split.seen(1, model.look).unflatten(0, (3, 30))
    # Of step 20: the frames of steps 8, 12, 16 and 20, which are stored one further on.
    assert torch.equal(other[:, 20], split.frames[:, [9, 13, 17, 21]])


def test_copies_of_a_worse_picture_are_as_bad_as_it_is() -> None:
    """A device that was switched on a moment ago remembers its first picture, noise and all."""
    frames = torch.arange(7, dtype=torch.uint8).reshape(1, 7, 1, 1, 1).expand(1, 7, 16, 32, 3)
    windows = FrameWindows(
        frames.contiguous(), torch.zeros(1, 6), window_frames=6, stride=1, mirror=False,
        look=(3, 2, 1, 0),
    )  # fmt: skip
    batch = windows.draw(1, np.random.default_rng(0))
    noisy = torch.rand(batch.frames.shape, generator=torch.manual_seed(0))
    seen = batch.shown(noisy).seen
    for k, alike in enumerate((3, 2, 1, 1)):
        first, *others = seen[k]
        assert [torch.equal(first, other) for other in others] == [
            place < alike for place in range(1, 4)
        ], k
        assert torch.equal(seen[k, alike - 1 :], noisy[k, alike - 1 :])
    assert torch.equal(batch.frames[0, 0], batch.frames[0, 2]) and batch.drawn


def test_the_loop_closes(trained: Path) -> None:
    model = Model.load(trained / "model" / "model.safetensors")
    simulator = Simulator(load_settings(flags=TINY), model)
    block = Block("hjepa", (Point("gap", 4.0),), 0, 2)
    outcome = block.compute(simulator, lambda steps: None)
    assert np.isfinite(outcome.cost).all() and outcome.flagged is not None


def test_frames_that_a_device_has_forgotten_are_refused() -> None:
    for flags, most in (({"encoder.frames": 4, "encoder.frame_gap": 6}, 5),
                        ({"encoder.frames": 2, "encoder.frame_gap": 16}, 15)):  # fmt: skip
        with pytest.raises(UsageError, match=f"choose 1 to {most}"):
            check_settings(load_settings(flags=flags))


def test_a_hardened_encoder_looks_further_back_than_its_teacher(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Targets are of frames next to each other; what learns sees those 0, 1, 4 and 9 steps back."""
    settings = load_settings(flags=TINY | {"encoder.frame_gap": 1})
    batches: list[tuple[Tensor, Tensor]] = []
    losses = Hardening.losses

    def look(self: Hardening, batch: TrajectoryBatch) -> dict[str, Tensor]:
        batches.append((batch.frames, batch.aimed_at))
        assert self.networks["teacher"].look == (3, 2, 1, 0)
        return losses(self, batch)

    monkeypatch.setattr(Hardening, "losses", look)
    model = train(settings, tmp_path)
    assert model.look == (9, 4, 1, 0) and model.architecture["frame_spacing"] == "square"
    split = render(open_dataset(tmp_path / "data", settings).split("train"), settings, QUIET)
    by_training = embed(model.networks["encoder"], split, settings)
    by_devices = embed_split(model, settings, "train").z
    torch.testing.assert_close(by_training[:, 8:], by_devices, atol=1e-4, rtol=1e-4)
    for seen, aimed_at in batches:  # the same present, the same step back, and then not
        assert torch.equal(seen[:, 2:], aimed_at[:, 2:])
        assert not torch.equal(seen[:, :2], aimed_at[:, :2])
    # Frames further apart differ by more, and are standardised by that.
    before, after = (
        load_checkpoint(tmp_path / of / "model.safetensors").tensors["encoder.input_std"]
        for of in ("encoder", "model")
    )
    more = torch.as_tensor(after / before).view(4, 3).mean(1)
    assert more[0] == pytest.approx(1, abs=0.05) and (more[2:] > 1.5).all(), more


@pytest.mark.parametrize(
    ("changes", "look"),
    [
        ({"augment.frames_within_s": 0.008}, (3, 2, 1, 0)),  # nine steps of 1 ms are longer
        ({"encoder.frame_gap": 2}, (6, 4, 2, 0)),  # 18 steps back is more than a device remembers
        ({"encoder.frames": 2}, (1, 0)),  # there is nothing between two
    ],
)
def test_frames_stay_where_they_are(
    changes: dict[str, object], look: tuple[int, ...], tmp_path: Path
) -> None:
    settings = load_settings(flags=TINY | {"encoder.frame_gap": 1} | changes)
    model = train(settings, tmp_path)
    assert model.look == look and "frame_spacing" not in model.architecture
