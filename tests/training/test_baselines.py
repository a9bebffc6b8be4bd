"""The baselines on raw frames: what they see, how they are trained, what they send."""

import csv
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from hjepa_cli.config.schema import EncoderSettings, Settings, look_of
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.drivers import build_driver, methods_of
from hjepa_cli.core.networks.decoder import Decoder, read_frames
from hjepa_cli.core.networks.encoder import Encoder
from hjepa_cli.core.networks.model import Model, build_modules
from hjepa_cli.core.networks.symmetry import flatten_twins, reflect, unflatten_twins
from hjepa_cli.core.plants.frames import LONGEST, frames_back, frames_seen
from hjepa_cli.core.training.batches import FrameWindows, TrajectoryBatch
from hjepa_cli.core.training.frame_policies import Imitation
from hjepa_cli.core.training.optimiser import Optimiser
from hjepa_cli.core.training.rendered import RenderedSplit, standardisation_sample
from hjepa_cli.errors import DataError, Interrupted, NumericalError, UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import baselines, collect, resume, train_encoder, train_hierarchy

QUIET = Screen(quiet=True)
TINY = {
    "control.gains_n": [],  # 4 trajectories: 4 steps are an epoch
    "collect.trajectories": 4,
    "collect.test_trajectories": 2,
    "collect.clean_trajectories": 2,
    "collect.steps": 20,
    "collect.clean_steps": 12,
    "encoder.embedding": 16,
    "encoder.hidden": 16,
    "actor.hidden": 16,
    "encoder.steps": 4,
    "encoder.batch_trajectories": 4,
    "encoder.batch_frames": 5,
    "encoder.gate": False,
}
KINDS: dict[str, dict[str, Any]] = {
    "supervised-2": {"encoder.method": "supervised", "encoder.frames": 2},
    "supervised-4": {"encoder.method": "supervised", "encoder.frames": 4},
    "autoencoder-2": {"encoder.method": "autoencoder", "encoder.frames": 2},
}


def settings(name: str = "supervised-2", **changes: Any) -> Settings:
    flags = {key.replace("__", "."): value for key, value in changes.items()}
    return load_settings(flags=TINY | KINDS[name] | flags)


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("baselines")
    collect.run(settings(), QUIET, out=root / "data")
    for name in KINDS:
        train_encoder.run(settings(name), QUIET, dataset=root / "data", out=root / name)
    return root


# ---- the frames that a device remembers ----------------------------------------------------------


def test_before_power_on_lie_copies_of_the_first_frame() -> None:
    assert frames_seen([0, 1, 2, 9], (3, 2, 1, 0)).tolist() == [
        [0, 0, 0, 1],
        [0, 0, 1, 2],
        [0, 1, 2, 3],
        [7, 8, 9, 10],
    ]
    assert frames_seen(5, (1, 0)).tolist() == [5, 6]
    assert frames_seen([3, 30], (12, 8, 4, 0)).tolist() == [[0, 0, 0, 4], [19, 23, 27, 31]]
    assert frames_back((15, 10, 5, 0)).tolist() == [-16, -11, -6, -1] and LONGEST == 16


def test_frames_lie_evenly_or_by_squares_back() -> None:
    assert look_of({"frames": 4}) == (3, 2, 1, 0) and look_of({}) == (1, 0)
    assert look_of({"frames": 4, "frame_gap": 5}) == (15, 10, 5, 0)
    assert look_of({"frames": 4, "frame_spacing": "square"}) == (9, 4, 1, 0)
    assert EncoderSettings().look == (3, 2, 1, 0) and EncoderSettings(frames=2).look == (1, 0)


LOOK = (3, 2, 1, 0)


def painted(trajectories: int, steps: int) -> torch.Tensor:
    """Frames whose pixels spell (stored index, trajectory, column)."""
    frames = torch.zeros(trajectories, steps + 1, 4, 6, 3, dtype=torch.uint8)
    frames[..., 0] = torch.arange(steps + 1, dtype=torch.uint8)[:, None, None]
    frames[..., 1] = torch.arange(trajectories, dtype=torch.uint8)[:, None, None, None]
    frames[..., 2] = torch.arange(6, dtype=torch.uint8)
    return frames


@pytest.mark.parametrize("frames", [2, 4])
def test_windows_carry_the_frames_and_labels_of_their_steps(frames: int) -> None:
    """Golden index test: every pixel and label says which step it is of."""
    data, steps = painted(5, 12), 12
    labels = 100.0 * torch.arange(5)[:, None] + torch.arange(steps)
    windows = FrameWindows(
        data,
        labels,
        window_frames=3,
        stride=4,
        mirror=True,
        labels=lambda rows, k, shifts_px: labels[rows, k],
        look=tuple(range(frames))[::-1],
    )
    batch = windows.draw(40, np.random.default_rng(0))
    assert batch.frames.shape == (120, frames, 4, 6, 3) and batch.labels is not None
    first = mirrored = 0
    for seen, label in zip(batch.frames, batch.labels, strict=True):
        row, k = divmod(abs(int(label)), 100)
        assert seen[-1, 0, 0, 1] == row
        assert seen[:, 0, 0, 0].tolist() == [max(k + 1 - back, 0) for back in range(frames)][::-1]
        flipped = int(seen[0, 0, 0, 2]) == 5
        if label != 0:
            assert flipped == bool(label < 0)
        first += k < frames - 1
        mirrored += flipped
    assert first and 0 < mirrored < 120


def test_splits_and_standardisation_look_at_the_same_frames() -> None:
    data = painted(3, 9)
    zeros = torch.zeros(3, 9)
    split = RenderedSplit(data, torch.zeros(3, 9, 4), zeros, zeros)
    seen = split.seen(1, LOOK).unflatten(0, (3, 9))
    for k in range(9):
        expected = [max(k + 1 - back, 0) for back in (3, 2, 1, 0)]
        assert seen[1, k, :, 0, 0, 0].tolist() == expected
    assert torch.equal(split.seen(3, LOOK, mirrored=True), seen[:, ::3].flatten(0, 1).flip(-2))
    sample = standardisation_sample(data, LOOK)
    assert {tuple(part[:, 0, 0, 0].tolist()) for part in sample} == {
        tuple(max(k + 1 - back, 0) for back in (3, 2, 1, 0)) for k in range(9)
    }


# ---- networks ------------------------------------------------------------------------------------


def test_inputs_of_four_frames_are_the_present_and_three_differences() -> None:
    frames = torch.randint(0, 256, (2, 4, 64, 128, 3), dtype=torch.uint8)
    shown = frames.float().permute(0, 1, 4, 2, 3)
    for frame_input in ("difference", "pair"):
        inputs = Encoder(16, frame_input, True, look=LOOK).inputs(frames).float()
        for back in range(4):
            expected = shown[:, 3 - back]
            if back and frame_input == "difference":
                expected = shown[:, 4 - back] - shown[:, 3 - back]
            assert torch.equal(inputs[:, 3 * back : 3 * back + 3], expected)


def scattered(module: torch.nn.Module, seed: int = 0) -> torch.nn.Module:
    """Weights and statistics as after some training: nothing is zero or one by default."""
    random = torch.Generator().manual_seed(seed)
    for parameter in module.parameters():
        parameter.data += 0.05 * torch.randn(parameter.shape, generator=random)
    return module.eval()


@pytest.mark.parametrize("name", KINDS)
def test_mirrored_frames_get_the_negated_force(name: str) -> None:
    torch.manual_seed(0)
    options = settings(name, encoder__photometric="none")
    networks = build_modules(train_encoder.describe_architecture(options))
    scattered(networks)
    frames = torch.randint(0, 256, (3, int(name[-1]), 64, 128, 3), dtype=torch.uint8)
    with torch.inference_mode():
        z, of_mirror = (read_frames(networks, part) for part in (frames, frames.flip(-2)))
        force, mirrored = (networks["actor"](part) for part in (z, of_mirror))
    torch.testing.assert_close(of_mirror, reflect(z), atol=1e-3, rtol=0)
    torch.testing.assert_close(mirrored, -force, atol=1e-5, rtol=0)
    assert force.abs().min() > 1e-4


def test_reflected_embeddings_are_painted_mirrored() -> None:
    z = torch.randn(3, 16)
    decoder = scattered(Decoder(16, symmetric=True))
    with torch.inference_mode():
        torch.testing.assert_close(decoder(reflect(z)), decoder(z).flip(-1), atol=1e-5, rtol=0)
        ordinary = scattered(Decoder(16))
        assert (ordinary(reflect(z)) - ordinary(z).flip(-1)).abs().max() > 1e-2
    maps = torch.randn(2, 8, 2, 4)
    assert torch.equal(unflatten_twins(flatten_twins(maps), 8, 2, 4), maps)


def test_a_decoder_that_paints_its_target_is_read_as_the_frames_themselves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With a perfect reconstruction the chain is the reader on the frames."""
    torch.manual_seed(0)
    architecture = train_encoder.describe_architecture(settings("autoencoder-2"))
    networks = build_modules(architecture).eval()
    frames = torch.randint(0, 256, (3, 2, 64, 128, 3), dtype=torch.uint8)
    sample = torch.randint(0, 256, (8, 2, 64, 128, 3), dtype=torch.uint8)
    baselines._standardise(networks, sample)
    inputs = networks["encoder"].inputs(frames)
    perfect = networks["decoder"].standardise(inputs)
    monkeypatch.setattr(networks["decoder"], "forward", lambda z: perfect)
    with torch.inference_mode():
        read, expected = read_frames(networks, frames), networks["reader"](frames)
    torch.testing.assert_close(read, expected, atol=1e-3, rtol=0)


# ---- training ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", KINDS)
def test_a_baseline_is_one_complete_checkpoint(name: str, workplace: Path) -> None:
    model = Model.load(workplace / name / "model.safetensors", "cpu")
    kappa = int(name[-1])
    assert methods_of(model) == (name,) and model.frames == kappa
    assert model.metadata["health"]["action_sensitivity"] is None
    rows = list(csv.DictReader((workplace / name / "metrics.csv").read_text().splitlines()))
    expected = {"force"} | ({"reconstruction"} if name == "autoencoder-2" else set())
    assert {row["term"] for row in rows} == expected
    frames = np.random.default_rng(0).integers(0, 256, (3, kappa, 64, 128, 3), np.uint8)
    with torch.inference_mode():
        forces_n = model.actor(model.encode(frames))
    assert forces_n.shape == (3,) and (forces_n.abs() <= 20).all()


def test_the_actor_s_phase_leaves_the_auto_encoder_alone() -> None:
    """Weights and running statistics alike; what it trains moves."""
    torch.manual_seed(0)
    networks = build_modules(train_encoder.describe_architecture(settings("autoencoder-2")))
    objective = Imitation(networks, ("reader", "actor"), torch.device("cpu"))
    before = {name: value.clone() for name, value in networks.state_dict().items()}
    frames = torch.randint(0, 256, (4, 2, 64, 128, 3), dtype=torch.uint8)
    batch = TrajectoryBatch(frames, torch.zeros(1, 3, 1), labels=torch.randn(4))
    update = torch.optim.SGD(objective.parameters(), lr=0.1)
    objective.train()
    objective.total(objective.losses(batch)).backward()
    update.step()
    moved = {
        name.partition(".")[0]
        for name, value in networks.state_dict().items()
        if not torch.equal(value, before[name])
    }
    assert moved == {"reader", "actor"}


@pytest.mark.parametrize("name", ["supervised-4", "autoencoder-2"])
def test_interrupted_and_continued_is_uninterrupted(
    name: str, workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped inside each loop; the bytes are those of the run that was not."""
    update, out, stops = Optimiser.step, tmp_path / "run", 0

    def step(self: Optimiser, *rest: Any) -> float:
        nonlocal steps
        steps += 1
        if steps == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return update(self, *rest)

    monkeypatch.setattr(Optimiser, "step", step)
    while not (out / "result.json").exists():
        steps = 0
        try:
            if stops:
                resume.run(out, QUIET)
            else:
                train_encoder.run(settings(name), QUIET, dataset=workplace / "data", out=out)
        except Interrupted:
            stops += 1
    assert stops == (2 if name == "autoencoder-2" else 1)
    for file in ("model.safetensors", "metrics.csv"):
        assert (out / file).read_bytes() == (workplace / name / file).read_bytes(), file


def test_the_gate_of_a_baseline_is_its_actor_alone(workplace: Path, tmp_path: Path) -> None:
    gated = settings(encoder__gate=True)
    with pytest.raises(
        NumericalError, match=r"failed its gate: actor_nrmse [\d.]+ \(gate 0\.35\)$"
    ):
        train_encoder.run(gated, QUIET, dataset=workplace / "data", out=tmp_path / "gated")
    report = {"probe_r2": {"x": 0.0}, "effective_rank": 1.0, "actor_nrmse": 0.35}
    assert list(train_encoder.judge(report, gated)) == ["actor_nrmse"]


def test_a_baseline_is_no_encoder_for_predictors(workplace: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="a baseline on raw frames"):
        train_hierarchy.run(
            settings(),
            QUIET,
            dataset=workplace / "data",
            encoder=str(workplace / "supervised-2"),
            out=tmp_path / "no",
        )
    assert not (tmp_path / "no").exists()


# ---- in the loop ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", KINDS)
def test_raw_frames_are_sent_whatever_the_payload(name: str, workplace: Path) -> None:
    model = Model.load(workplace / name / "model.safetensors", "cpu")
    kappa = int(name[-1])
    for payload in ("int8", "pca-4x4"):
        method = build_driver(name, settings(protocol__payload=payload), model)
        assert method.bits_per_transmission == kappa * 64 * 128 * 3 * 8
    states = 0.02 * np.random.default_rng(0).normal(size=(3, 4, 4))
    frames = method.sensor(states)
    assert frames.shape == (3, kappa, 64, 128, 3) and frames.dtype == np.uint8
    controller = method.controller(3)
    with torch.inference_mode():
        expected = model.actor(model.encode(frames)).numpy()
    everybody = np.ones(3, dtype=bool)
    assert controller.act(everybody, frames) == pytest.approx(expected, abs=1e-4)
    assert controller.act(~everybody, None) == pytest.approx(expected, abs=1e-4)  # held
    late = build_driver(f"{name}+3", settings(), model)
    assert late.delay_steps == 3 and late.family != method.family
    assert late.name == f"{name}+3"  # by which its loops are driven
    with pytest.raises(UsageError, match="needs a model of it"):
        build_driver("hjepa", settings(), model)
