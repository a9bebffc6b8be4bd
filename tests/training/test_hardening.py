"""An encoder learns to see in worse pictures what it has learned to see in clean ones."""

import copy
import csv
import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from hjepa_cli.config.schema import AugmentSettings, Settings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.datasets.dataset import load_dataset
from hjepa_cli.core.networks import health
from hjepa_cli.core.networks.actor import Actor
from hjepa_cli.core.networks.model import LEVELS, load_modules
from hjepa_cli.core.networks.predictors import Predictor
from hjepa_cli.core.plants.named import Camera, plant_of
from hjepa_cli.core.training.augmentation import Augmentation
from hjepa_cli.core.training.batches import FrameWindows, TrajectoryBatch
from hjepa_cli.core.training.hardening import Hardening
from hjepa_cli.core.training.jepa import Jepa
from hjepa_cli.core.training.optimiser import Optimiser
from hjepa_cli.core.training.rendered import standardisation_sample
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import collect, frame_training, train_encoder, train_hierarchy
from hjepa_cli.stages.inputs import embed, render
from hjepa_cli.stages.training import untrained
from hjepa_cli.storage.checkpoints import load_checkpoint

QUIET, CPU = Screen(quiet=True), torch.device("cpu")
PLANNED = AugmentSettings(force_steps=12)
TINY = {
    "device": "cpu",
    "collect.trajectories": 3,
    "collect.test_trajectories": 2,
    "collect.clean_trajectories": 1,
    "collect.steps": 30,  # of which windows see the first 20
    "encoder.frames": 2,
    "encoder.embedding": 16,
    "encoder.hidden": 16,
    "encoder.steps": 2,
    "encoder.batch_trajectories": 6,  # 2 steps are one epoch of 3 trajectories, and of 6 it is 4
    "encoder.batch_frames": 5,
    "encoder.gate": False,
    "augment.steps": 4,
    "actor.hidden": 16,
    "actor.epochs": 1,
    "actor.batch": 40,
    "hierarchy.shifted_copies": 0,
    "hierarchy.rollout_steps": 8,
    "hierarchy.batch_trajectories": 2,
    "hierarchy.coarse_steps": 1,
    "hierarchy.flat_steps": 1,
    "hierarchy.medium_steps": 1,
    "hierarchy.low_steps": 1,
    "protocol.horizon": 10,
    "collect.clean_steps": 12,
}


def settings(**changes: object) -> Settings:
    return load_settings(flags=TINY | {key.replace("__", "."): v for key, v in changes.items()})


def pictures(count: int) -> Tensor:
    """Inputs uint8 [count, 2, 64, 128, 3] of cart-poles that stand anywhere."""
    stream = torch.Generator().manual_seed(3)
    wide = torch.tensor([0.1, 0.5, 0.3, 3.0])
    states = (2 * torch.rand(count, 4, generator=stream) - 1) * wide
    before = states - 0.02 * states[:, [1, 1, 3, 3]] * torch.tensor([1.0, 0.0, 1.0, 0.0])
    camera = Camera("desktop")
    both = [torch.from_numpy(camera.render(of.double().numpy())) for of in (before, states)]
    return torch.stack(both, dim=1)


@pytest.fixture(scope="module")
def learned() -> nn.ModuleDict:
    """An encoder and its companion, with statistics of some pictures."""
    torch.manual_seed(0)
    options = settings()
    modules = untrained(train_hierarchy.describe_architecture(options), options)
    encoder: Any = modules["encoder"]
    frames = pictures(24)
    encoder.fit_standardisation(frames)
    encoder.train()
    with torch.no_grad():
        for _ in range(20):
            encoder(frames)
    encoder.eval()
    return modules


@pytest.fixture
def networks(learned: nn.ModuleDict) -> nn.ModuleDict:
    return copy.deepcopy(learned)


@pytest.fixture
def batch() -> TrajectoryBatch:
    frames = pictures(12)
    options = dataclasses.replace(AugmentSettings(), clean=0.0, share=1.0)
    worse = Augmentation(options)(frames, [5])
    return TrajectoryBatch(frames, torch.zeros(3, 3, 4), worse=worse)


def copied(networks: nn.Module) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in networks.state_dict().items()}


def hardened(hardening: Hardening, batch: TrajectoryBatch, steps: int) -> list[float]:
    """Return the losses of some steps on one batch."""
    optimiser = Optimiser(
        hardening.parameters(), name="adamw", schedule="constant", steps=steps,
        learning_rate=5e-4, weight_decay=1e-2, gradient_clip=1.0,
    )  # fmt: skip
    losses = []
    for step in range(steps):
        hardening.train()
        terms = hardening.losses(batch)
        assert set(terms) == {"hardening", "force"}
        losses.append(optimiser.step(hardening.total(terms), step))
        hardening.after_step()
    return losses


def test_it_begins_with_what_was_learned(networks: nn.ModuleDict, batch: TrajectoryBatch) -> None:
    """Clean pictures are seen as before the first step, and there is nothing to learn of them."""
    before = networks["encoder"](batch.frames)
    hardening = Hardening(networks, CPU, PLANNED, 4)
    hardening.train()
    assert hardening.networks["encoder"] is networks["encoder"]
    for name in ("encoder", "teacher"):
        assert torch.equal(hardening.networks[name](batch.frames), before), name
    clean = dataclasses.replace(batch, worse=None)
    with torch.no_grad():
        assert float(hardening.losses(clean)["hardening"]) == pytest.approx(0.0, abs=1e-5)
        assert float(hardening.losses(batch)["hardening"]) > 1e-3


def test_weights_of_the_encoder_change_and_nothing_else(
    networks: nn.ModuleDict, batch: TrajectoryBatch
) -> None:
    """Neither the teacher, nor other networks, nor any statistics of a batch norm."""
    hardening = Hardening(networks, CPU, PLANNED, 4)
    before = copied(hardening.networks)
    hardened(hardening, batch, 3)
    after = hardening.networks.state_dict()
    weights = {f"encoder.{name}" for name, _ in networks["encoder"].named_parameters()}
    assert any("running_var" in name for name in before.keys() - weights)
    for name, value in before.items():
        assert torch.equal(after[name], value) == (name not in weights), name
    assert {id(value) for value in hardening.parameters()} == {
        id(value) for value in networks["encoder"].parameters()
    }
    assert all(value.grad is None for value in networks["high"].parameters())
    assert not any(module.training for module in hardening.networks.modules())
    (part,) = hardening.parts().values()
    assert part.state_dict().keys() == before.keys(), "and all of it is saved"


def test_forces_are_planned_from_both_embeddings(
    networks: nn.ModuleDict, batch: TrajectoryBatch
) -> None:
    """As a controller plans them: the actor's clipped force, held for a stride, then P^H's next."""
    actor: Any = networks["actor"]
    for linear in (actor.layers[0], actor.layers[3]):
        nn.init.normal_(linear.odd.weight, std=1.0)
    nn.init.normal_(actor.layers[-1].odd.weight, std=2.0)  # some forces are clipped, others not
    nn.init.normal_(networks["high"].output.even.weight, std=0.2)
    hardening = Hardening(networks, CPU, PLANNED, 4)
    hardening.train()
    seen = networks["encoder"](batch.worse), hardening.networks["teacher"](batch.frames)
    errors, clipped = [], 0
    for row in zip(*(z.detach() for z in seen), strict=True):
        planned = []
        for z in row:
            forces = []
            for _ in range(3):  # 12 steps of strides of 4
                force = max(-1.0, min(1.0, float(actor(z[None]))))
                clipped += abs(force) == 1.0
                forces.append(force)
                z = networks["high"](z[None], torch.full((1, 4), force))[0]
            planned.append(forces)
        errors += [(a - b) ** 2 for a, b in zip(*planned, strict=True)]
    assert 0 < clipped < 2 * len(errors)
    terms = hardening.losses(batch)
    expected = PLANNED.force_weight * sum(errors) / len(errors)
    assert float(terms["force"].detach()) == pytest.approx(expected, rel=1e-4)
    total = float(terms["hardening"].detach()) + float(terms["force"].detach())
    assert float(hardening.total(terms).detach()) == pytest.approx(total, rel=1e-6)


@pytest.mark.parametrize("shape", [(), (2,)], ids=str)
@pytest.mark.parametrize("level", ["high", "flat"])
def test_plans_of_any_plant_and_of_one_level(shape: tuple[int, ...], level: str) -> None:
    """A model of stride 1 has no P^H; several forces are held together."""
    count = 2 if shape else 1
    stride = 4 if level == "high" else 1
    networks = nn.ModuleDict(
        {
            "encoder": nn.Identity(),
            "actor": Actor(16, 8, 0.2, shape).eval(),
            level: Predictor(16, 8, stride * count),
        }
    )
    hardening = Hardening(networks, CPU, PLANNED, stride)
    z = torch.randn(3, 16)
    forces = hardening.plan(z)
    assert forces.shape == (12 // stride, 3, *shape)
    assert torch.equal(forces[0], networks["actor"].act(z))
    after = networks[level](z, torch.stack([forces[0]] * stride, dim=1))
    assert torch.allclose(forces[1], networks["actor"].act(after))


def test_forces_get_closer(networks: nn.ModuleDict, batch: TrajectoryBatch) -> None:
    """Their error is minimised; without a weight no forces are planned, and no actor is needed."""
    nn.init.normal_(networks["actor"].layers[-1].odd.weight, std=0.5)
    settings = dataclasses.replace(PLANNED, force_weight=20.0)
    hardening = Hardening(networks, CPU, settings, 4)

    def error() -> float:
        with torch.no_grad():
            return float(hardening.losses(batch)["force"])

    hardening.train()
    before = error()
    hardened(hardening, batch, 15)
    assert error() < 0.5 * before
    off = Hardening(
        nn.ModuleDict({"encoder": networks["encoder"]}), CPU,
        dataclasses.replace(PLANNED, force_weight=0.0), 4,
    )  # fmt: skip
    assert off.losses(batch).keys() == {"hardening"}


def test_it_learns(networks: nn.ModuleDict, batch: TrajectoryBatch) -> None:
    """Worse pictures get closer to clean ones, of which the embeddings hardly move."""
    losses = hardened(Hardening(networks, CPU, PLANNED, 4), batch, 15)
    assert min(losses[-3:]) < 0.6 * losses[0], losses


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset, its encoder, and a hierarchy on it with and without hardening."""
    root = tmp_path_factory.mktemp("hardening")
    monkeypatch = pytest.MonkeyPatch()
    monkeypatch.setattr(frame_training, "MOTION_STEPS", 20)  # whose windows are as short
    collect.run(settings(), QUIET, out=root / "data")
    train_encoder.run(settings(), QUIET, dataset=root / "data", out=root / "encoder")
    for name, strength in (("hard", 1.0), ("soft", 0.0)):
        levels(root, name, augment__strength=strength)
    monkeypatch.undo()
    return root


def levels(root: Path, out: str, encoder: str = "encoder", **changes: object) -> dict[str, Any]:
    return train_hierarchy.run(
        settings(**changes), QUIET, dataset=root / "data", encoder=str(root / encoder),
        out=root / out,
    )  # fmt: skip


def tensors(path: Path) -> dict[str, Any]:
    return dict(load_checkpoint(path / "model.safetensors").tensors)


@pytest.mark.parametrize("law", [True, False], ids=["tuned law", "teacher alone"])
def test_a_jepa_learns_from_what_the_teacher_drives(
    law: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In clean pictures, and of no more steps than a window has; all of the others come later."""
    options = settings() if law else settings(control__gains_n=[])
    assert bool(options.control.gains_n) == law
    collect.run(options, QUIET, out=tmp_path / "data")
    seen: dict[str, list[Tensor]] = {"jepa": [], "hardening": []}
    windows: list[Tensor] = []
    monkeypatch.setattr(frame_training, "MOTION_STEPS", 20)
    make = FrameWindows.__init__

    def of_windows(self: FrameWindows, frames: Tensor, actions: Tensor, **rest: Any) -> None:
        windows.append(actions)
        make(self, frames, actions, **rest)

    monkeypatch.setattr(FrameWindows, "__init__", of_windows)
    objectives: dict[str, Any] = {"jepa": Jepa, "hardening": Hardening}
    for phase, objective in objectives.items():

        def losses(
            self: Any, batch: TrajectoryBatch, phase: str = phase, real: Any = objective.losses
        ) -> dict[str, Tensor]:
            assert (batch.worse is None) == (phase == "jepa") and batch.labels is None
            seen[phase].append(windows[-1])
            found: dict[str, Tensor] = real(self, batch)
            return found

        monkeypatch.setattr(objective, "losses", losses)
    train_encoder.run(options, QUIET, dataset=tmp_path / "data", out=tmp_path / "encoder")
    assert not seen["hardening"]
    train_hierarchy.run(
        options, QUIET, dataset=tmp_path / "data", encoder=str(tmp_path / "encoder"),
        out=tmp_path / "model",
    )  # fmt: skip
    train = load_dataset(tmp_path / "data").split("train")
    actions = torch.from_numpy(train.applied_n / 20.0)
    assert len(actions) == (6 if law else 3)
    calm = slice(1, None, 2) if law else slice(None)
    assert (len(seen["jepa"]), len(seen["hardening"])) == (2, 4)
    assert all(torch.equal(of, actions[calm, :20]) for of in seen["jepa"])
    assert all(torch.equal(of, actions[:, :20]) for of in seen["hardening"])
    # Inputs are standardised by the pictures that it learns from.
    frames = torch.from_numpy(Camera("desktop").render(train.states[calm].reshape(-1, 4)))
    sample = standardisation_sample(frames.unflatten(0, train.states[calm].shape[:2]), (1, 0))
    fresh: Any = untrained(train_encoder.describe_architecture(options), options)["encoder"]
    fresh.fit_standardisation(sample)
    saved = load_checkpoint(tmp_path / "encoder" / "model.safetensors")
    trained: Any = load_modules(saved)["encoder"]
    assert torch.equal(trained.input_mean, fresh.input_mean)
    assert torch.equal(trained.input_std, fresh.input_std)


def test_a_hierarchy_hardens_its_encoder_last(workplace: Path) -> None:
    """Actor and levels are what they would be without; so is all of the encoder but its weights."""
    encoder, hard, soft = (tensors(workplace / name) for name in ("encoder", "hard", "soft"))
    assert hard.keys() == soft.keys() and not any("teacher" in name for name in hard)
    of_encoder = load_modules(load_checkpoint(workplace / "hard" / "model.safetensors"))["encoder"]
    weights = {f"encoder.{name}" for name, _ in of_encoder.named_parameters()}
    moved = {name for name, value in hard.items() if (value != soft[name]).any()}
    assert moved and moved <= weights
    for name, value in soft.items():
        if name.startswith("encoder.") and name not in weights:
            assert (value == encoder[name]).all(), name


def test_hardening_is_told_in_metrics(workplace: Path) -> None:
    rows = [
        list(csv.DictReader((workplace / name / "metrics.csv").read_text().splitlines()))
        for name in ("hard", "soft")
    ]
    assert rows[0][:-1] == rows[1] and {row["level"] for row in rows[1]} == {*LEVELS["hierarchy"]}
    assert (rows[0][-1]["level"], rows[0][-1]["step"]) == ("hardening", "4")
    assert 0 < float(rows[0][-1]["loss"]) < 1


@pytest.mark.parametrize("name", ["hard", "soft"])
def test_health_is_that_of_the_weights_that_are_saved(workplace: Path, name: str) -> None:
    """Hardening moves the encoder, and rounding does: that of an encoder's run is of others."""
    checkpoint = load_checkpoint(workplace / name / "model.safetensors")
    told, encoder = checkpoint.metadata["health"], load_modules(checkpoint)["encoder"].eval()
    options = settings()
    train, test = (
        render(load_dataset(workplace / "data").split(split), options, QUIET, split)
        for split in ("train", "test")
    )
    train_z, z = (embed(encoder, split, options).flatten(0, 1) for split in (train, test))
    assert told["effective_rank"] == pytest.approx(health.effective_rank(z), rel=1e-6)
    assert told["std"] == pytest.approx(float(z.std(0).mean()), rel=1e-6)
    states, names = (train.states_at(1), test.states_at(1)), plant_of(options).state_names
    r2 = health.probe_r2(train_z, states[0], z, states[1], names)
    assert told["probe_r2"] == pytest.approx(r2, rel=1e-6)
    before = load_checkpoint(workplace / "encoder" / "model.safetensors").metadata["health"]
    assert before["effective_rank"] != told["effective_rank"] and told.keys() == before.keys()


def test_an_encoder_is_hardened_once(workplace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """That of a hierarchy is hard already; without worse pictures there is nothing to harden."""

    def refused(*_: Any) -> None:
        pytest.fail("hardened again")

    monkeypatch.setattr(Hardening, "__init__", refused)
    levels(workplace, "on-a-hierarchy", encoder="hard")
    levels(workplace, "off", augment__strength=0.0)
    first, second = (tensors(workplace / name) for name in ("hard", "on-a-hierarchy"))
    assert all((of == first[name]).all() for name, of in second.items() if "encoder." in name)


def test_four_frames_are_hardened_as_they_were_learned(
    workplace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An encoder brings its own frames along; settings of another one do not matter."""
    apart = {"encoder__frames": 4, "encoder__frame_gap": 2}
    train_encoder.run(settings(**apart), QUIET, dataset=workplace / "data", out=workplace / "apart")
    seen: list[Tensor] = []
    losses = Hardening.losses

    def look(self: Hardening, batch: TrajectoryBatch) -> dict[str, Tensor]:
        seen.append(batch.frames)
        return losses(self, batch)

    monkeypatch.setattr(Hardening, "losses", look)
    levels(workplace, "on-apart", encoder="apart")
    assert {frames.shape[1:] for frames in seen} == {(4, 64, 128, 3)}
