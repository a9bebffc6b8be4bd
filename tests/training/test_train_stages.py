"""Both training stages on a handful of trajectories: what they save, refuse and repeat."""

import csv
import dataclasses
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from hjepa_cli.config.schema import Settings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.drivers import build_driver, methods_of, planner_of
from hjepa_cli.core.networks.model import Model, encode_frames, load_modules
from hjepa_cli.core.networks.symmetry import reflect
from hjepa_cli.core.plants.cartpole.plant import CartPolePlant
from hjepa_cli.core.plants.system import System
from hjepa_cli.errors import DataError, NumericalError, UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.plugins import METHODS
from hjepa_cli.stages import collect, embedding_training, inputs, train_encoder, train_hierarchy
from hjepa_cli.stages.train_hierarchy import open_encoder
from hjepa_cli.storage.checkpoints import load_checkpoint

QUIET = Screen(quiet=True)
TINY = {
    "control.gains_n": [],
    "encoder.frames": 2,
    "augment.strength": 0.0,  # encoders stay as they are: test_hardening.py has the others
    "collect.trajectories": 6,
    "collect.steps": 100,
    "collect.test_trajectories": 4,
    "collect.clean_trajectories": 2,
    "encoder.steps": 4,
    "encoder.batch_trajectories": 6,  # 4 steps are one epoch: one row of metrics
    "encoder.gate": False,
    "actor.epochs": 1,
    "hierarchy.rollout_steps": 8,
    "hierarchy.batch_trajectories": 2,
    "hierarchy.coarse_steps": 2,
    "hierarchy.flat_steps": 2,
    "hierarchy.medium_steps": 2,
    "hierarchy.low_steps": 2,
}

FITTED = [*(name for name in METHODS if METHODS[name].fitted), "local"]


def settings(**changes: object) -> Settings:
    return load_settings(flags=TINY | {key.replace("__", "."): v for key, v in changes.items()})


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset and an encoder, made once."""
    root = tmp_path_factory.mktemp("train")
    collect.run(settings(), QUIET, out=root / "data")
    train_encoder.run(settings(), QUIET, dataset=root / "data", out=root / "encoder")
    return root


def train(root: Path, out: str, encoder: str = "encoder", **changes: object) -> Model:
    result = train_hierarchy.run(
        settings(**changes),
        QUIET,
        dataset=root / "data",
        encoder=str(root / encoder),
        out=root / out,
    )
    return Model.load(Path(result["checkpoint"]), "cpu")


def networks(path: Path) -> torch.nn.ModuleDict:
    """What a run trained."""
    return load_modules(load_checkpoint(path / "model.safetensors"))


def test_the_encoder_run_repeats_to_the_last_bit(workplace: Path) -> None:
    train_encoder.run(settings(), QUIET, dataset=workplace / "data", out=workplace / "again")
    first, again = (
        load_checkpoint(workplace / name / "model.safetensors") for name in ("encoder", "again")
    )
    assert first.digest == again.digest
    train_encoder.run(settings(seed=1), QUIET, dataset=workplace / "data", out=workplace / "other")
    assert load_checkpoint(workplace / "other" / "model.safetensors").digest != first.digest


def test_the_encoder_checkpoint_says_all_about_itself(workplace: Path) -> None:
    metadata = load_checkpoint(workplace / "encoder" / "model.safetensors").metadata
    assert metadata["plant"] == "desktop" and metadata["seed"] == 0
    assert set(metadata["health"]["probe_r2"]) == {"x", "x_dot", "theta", "theta_dot"}
    assert metadata["settings"]["encoder"]["steps"] == 4
    assert metadata["camera"]["width_px"] == 128 and len(metadata["dataset"]) == 64


def test_pictures_that_cannot_be_moved_are_not_trained_on(
    workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An encoder asks for no labels, which would find out."""
    monkeypatch.setattr(CartPolePlant, "sideways", System.sideways)
    with pytest.raises(UsageError, match="does not say what moving its picture sideways means"):
        train_encoder.run(settings(), QUIET, dataset=workplace / "data", out=tmp_path / "out")
    still = settings(encoder__shift_px=0)
    train_encoder.run(still, QUIET, dataset=workplace / "data", out=tmp_path / "still")


@pytest.mark.parametrize("changes", [{}, {"mirror": "augment", "h": 2}, {"method": "supervised"}])
def test_plans_count_the_frames_that_are_encoded(
    workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, object]
) -> None:
    """In the looks at training and in the examination at its end."""
    options = settings(**{f"encoder__{key}": value for key, value in changes.items()})
    encoded = 0

    def encode(encoder: object, frames: torch.Tensor, **rest: object) -> torch.Tensor:
        nonlocal encoded
        encoded += len(frames)
        return encode_frames(encoder, frames, **rest)  # type: ignore[arg-type]

    monkeypatch.setattr(inputs, "encode_frames", encode)
    monkeypatch.setattr(train_encoder, "plan_training", lambda *_, amounts, **__: amounts)
    amounts: Any = train_encoder.plan(options, dataset=workplace / "data")
    train_encoder.run(options, QUIET, dataset=workplace / "data", out=tmp_path / "out")
    # Plans count frames as they are stored, of which each trajectory has one more.
    assert amounts["encoded frames"] == pytest.approx(encoded, rel=0.02)


def test_a_missed_gate_stops_the_pipeline_and_leaves_no_checkpoint(workplace: Path) -> None:
    out = workplace / "gated"
    with pytest.raises(NumericalError, match=r"failed its gate.*theta") as caught:
        train_encoder.run(settings(encoder__gate=True), QUIET, dataset=workplace / "data", out=out)
    assert "--no-gate" in str(caught.value.hint)
    assert "rejected.safetensors" in str(caught.value.hint)
    assert not (out / "model.safetensors").exists() and not (out / "result.json").exists()


def test_gates_pass_exactly_at_their_thresholds() -> None:
    options = load_settings()
    health = {
        "probe_r2": {"x": 0.95, "x_dot": 0.90, "theta": 0.80, "theta_dot": 0.90},
        "effective_rank": 4.0,
        "std": 0.0,
        "action_sensitivity": 0.1,
        "actor_nrmse": 0.35,
    }
    gates = train_encoder.judge(health, options)
    assert len(gates) == 7 and all(gate["passed"] for gate in gates.values())
    for change in ({"effective_rank": 3.99}, {"actor_nrmse": 0.36}, {"action_sensitivity": 0.0}):
        failed = train_encoder.judge(health | change, options)
        assert [name for name, gate in failed.items() if not gate["passed"]] == list(change)
    assert not train_encoder.judge(health | {"effective_rank": float("nan")}, options)[
        "effective_rank"
    ]["passed"]


def test_the_hierarchy_takes_the_encoder_as_it_is(workplace: Path) -> None:
    model = train(workplace, "hierarchy")
    source = networks(workplace / "encoder")
    taken = networks(workplace / "hierarchy")["encoder"].state_dict()
    weights = {name for name, _ in source["encoder"].named_parameters()}
    for name, tensor in source["encoder"].state_dict().items():
        rounded = tensor.bfloat16().float() if name in weights else tensor
        assert torch.equal(taken[name], rounded), name
    assert methods_of(model) == ("hjepa", "ts-jepa-4", "ts-jepa-1", "hold", "zero", *FITTED)
    with (workplace / "hierarchy" / "metrics.csv").open() as lines:
        assert {row["level"] for row in csv.DictReader(lines)} == {"high", "medium", "low", "flat"}


def test_the_hierarchy_run_repeats_to_the_last_bit(workplace: Path) -> None:
    digests = {train(workplace, name, seed=5).digest for name in ("once", "twice")}
    assert len(digests) == 1


@pytest.mark.parametrize(("h", "m", "l"), [(8, 2, 1), (4, 4, 1), (6, 2, 2)])
def test_other_strides_train_and_play(workplace: Path, h: int, m: int, l: int) -> None:
    model = train(workplace, f"strides-{h}-{m}-{l}", hierarchy__h=h, hierarchy__m=m, hierarchy__l=l)
    z = model.encode(np.zeros((3, 2, 64, 128, 3), np.uint8))
    for method in ("hjepa", f"ts-jepa-{h}", "ts-jepa-1"):
        planner = planner_of(model, method)
        with torch.inference_mode():
            forces_n, z_next = planner.plan(z)
        assert forces_n.shape == (3, planner.stride) and z_next.shape == z.shape
        assert (forces_n.abs() <= 20.0).all()
    assert planner_of(model, "hjepa").stride == h


@pytest.mark.parametrize("h", [1, 2, 4])
def test_one_level_is_ts_jepa_of_that_depth(workplace: Path, h: int) -> None:
    model = train(workplace, f"flat-{h}", hierarchy__h=h, hierarchy__m=h, hierarchy__l=h)
    planned = dict.fromkeys((f"ts-jepa-{h}", "ts-jepa-1"))
    assert methods_of(model) == (*planned, "hold", "zero", *FITTED)
    names = {name.partition(".")[0] for name in model.networks.state_dict()}
    assert names == {"encoder", "actor", "flat"} | ({"high"} if h > 1 else set())
    z = model.encode(np.zeros((3, 2, 64, 128, 3), np.uint8))
    with torch.inference_mode():
        forces_n, _ = planner_of(model, f"ts-jepa-{h}").plan(z)
    assert forces_n.shape == (3, h)
    with pytest.raises(UsageError, match="no planner 'hjepa'"):
        planner_of(model, "hjepa")


def test_the_high_level_starts_from_nothing(workplace: Path) -> None:
    """Not from the companion of the encoder, nor from that of a hierarchy on its encoder."""
    frozen = {"hierarchy__coarse_learning_rate": 0.0}
    source = networks(workplace / "encoder")["high"].state_dict()
    train(workplace, "from-nothing", **frozen)
    fresh = networks(workplace / "from-nothing")["high"].state_dict()
    assert not any(torch.equal(fresh[name], source[name]) for name in fresh if "weight" in name)
    again = train_hierarchy.run(
        settings(**frozen),
        QUIET,
        dataset=workplace / "data",
        encoder=str(workplace / "from-nothing"),
        out=workplace / "on-a-trained-one",
    )
    assert again["method"] == "hjepa"
    same = networks(workplace / "on-a-trained-one")["high"].state_dict()
    assert all(torch.equal(fresh[name], same[name]) for name in fresh), "drawn by the seed"


def test_an_interrupted_run_starts_again_and_ends_the_same(workplace: Path) -> None:
    out = workplace / "interrupted"
    options = settings()
    spoiled = dataclasses.replace(options, encoder=dataclasses.replace(options.encoder, gate=True))
    with pytest.raises(NumericalError):
        train_encoder.run(spoiled, QUIET, dataset=workplace / "data", out=out)
    with pytest.raises(NumericalError):  # same settings: taken up, metrics not doubled
        train_encoder.run(spoiled, QUIET, dataset=workplace / "data", out=out)
    fresh = (workplace / "gated" / "metrics.csv").read_bytes()
    assert (out / "metrics.csv").read_bytes() == fresh
    assert len(fresh.splitlines()) == 2


def test_any_checkpoint_brings_its_encoder_but_only_a_hierarchy_drives(workplace: Path) -> None:
    train(workplace, "first")
    train_hierarchy.run(
        settings(),
        QUIET,
        dataset=workplace / "data",
        encoder=str(workplace / "first"),
        out=workplace / "on-a-hierarchy",
    )
    first, second = (
        networks(workplace / name)["encoder"].state_dict() for name in ("first", "on-a-hierarchy")
    )
    for name, tensor in first.items():
        assert torch.equal(second[name], tensor), name
    with pytest.raises(DataError, match="of train-encoder, not of train-hierarchy"):
        Model.load(workplace / "encoder" / "model.safetensors")


def test_an_encoder_of_another_symmetry_is_not_taken(
    workplace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(workplace)
    named = Path("runs/train-encoder/0001")
    train_encoder.run(settings(encoder__mirror="augment"), QUIET, dataset=workplace / "data")
    assert open_encoder(None, settings(encoder__mirror="augment"), QUIET).path.parent == named
    assert open_encoder(None, settings(encoder__mirror="none"), QUIET).path.parent != named
    shutil.rmtree("runs")


def test_other_strides_share_what_depends_on_none(workplace: Path) -> None:
    train(workplace, "whole")
    first = networks(workplace / "whole")

    def shared(out: str, **changes: object) -> list[bool]:
        train(workplace, out, encoder="whole", **changes)
        second = networks(workplace / out)
        return [
            all(map(torch.equal, first[name].parameters(), second[name].parameters()))
            for name in ("actor", "flat", "high")
        ]

    assert shared("shared", hierarchy__h=2, hierarchy__m=1) == [True, True, False]
    assert shared("more-steps", hierarchy__h=2, hierarchy__m=1, hierarchy__coarse_steps=3)[:2] == [
        True,
        True,
    ]
    assert shared("longer", hierarchy__h=2, hierarchy__m=1, hierarchy__flat_steps=3)[1] is False
    assert shared("other-actor", hierarchy__h=2, hierarchy__m=1, actor__dropout=0.5)[0] is False
    assert shared("other-seed", hierarchy__h=2, hierarchy__m=1, seed=1) == [False] * 3


def test_the_actor_s_error_is_measured_without_dropout(workplace: Path) -> None:
    """Two models that share an actor tell the same error, whatever random numbers are left."""
    train(workplace, "told", actor__dropout=0.5)
    train(workplace, "told-again", encoder="told", actor__dropout=0.5, hierarchy__coarse_steps=3)
    first, second = (
        load_checkpoint(workplace / name / "model.safetensors").metadata["health"]
        for name in ("told", "told-again")
    )
    assert first["actor_nrmse"] == second["actor_nrmse"]


def test_a_rejected_encoder_is_kept_apart_and_can_be_used(workplace: Path) -> None:
    rejected = workplace / "gated" / "rejected.safetensors"
    result = train_hierarchy.run(
        settings(),
        QUIET,
        dataset=workplace / "data",
        encoder=str(rejected),
        out=workplace / "on-a-rejected",
    )
    assert load_checkpoint(Path(result["checkpoint"])).metadata["encoder"] == (
        load_checkpoint(rejected).digest
    )


def test_frames_are_flipped_for_encoders_that_were_trained_so(workplace: Path, monkeypatch) -> None:
    flipped = settings(encoder__mirror="augment")
    train_encoder.run(flipped, QUIET, dataset=workplace / "data", out=workplace / "flipped-encoder")
    seen: list[tuple[torch.Tensor, torch.Tensor]] = []
    fit = embedding_training.fit_actor

    def spy(z, labels, *rest, **options):
        seen.append((z, labels))
        return fit(z, labels, *rest, **options)

    monkeypatch.setattr(embedding_training, "fit_actor", spy)
    symmetric = train(workplace, "plain")
    flipped = train(workplace, "mirrored", "flipped-encoder")
    (plain_z, plain), (both_z, both) = seen
    recorded, views = 600, 1 + settings().hierarchy.shifted_copies
    assert len(plain_z) == len(plain) == views * recorded
    assert len(both_z) == len(both) == 2 * len(plain)
    mirrored = both[len(plain) :]
    assert torch.equal(both[: len(plain)], plain)  # then the same places in the mirror
    assert torch.equal(mirrored[:recorded], -plain[:recorded])
    assert not torch.equal(mirrored, -plain)
    modes = [model.architecture["mirror"] for model in (symmetric, flipped)]
    assert modes == ["exact", "augment"]


def test_a_trained_model_treats_both_sides_alike(workplace: Path) -> None:
    model = train(workplace, "both-sides")
    frames = np.random.default_rng(0).integers(0, 256, (5, 2, 64, 128, 3), np.uint8)
    z, of_mirror = model.encode(frames), model.encode(frames[:, :, :, ::-1].copy())
    torch.testing.assert_close(of_mirror, reflect(z), atol=0.05, rtol=0)  # bfloat16
    for name in ("hjepa", "ts-jepa-1", "ts-jepa-4"):
        with torch.inference_mode():
            forces_n, ahead = planner_of(model, name).plan(z)
            of_mirror_n, of_mirror_ahead = planner_of(model, name).plan(reflect(z))
        torch.testing.assert_close(of_mirror_n, -forces_n, atol=0.02, rtol=0)
        torch.testing.assert_close(of_mirror_ahead, reflect(ahead), atol=0.02, rtol=0)


def test_levels_do_not_disturb_each_other(workplace: Path) -> None:
    train(workplace, "short", hierarchy__medium_steps=1)
    train(workplace, "long", hierarchy__medium_steps=3)
    short, long = (networks(workplace / name) for name in ("short", "long"))
    for name in ("high", "flat"):
        for a, b in zip(short[name].parameters(), long[name].parameters(), strict=True):
            assert torch.equal(a, b)


def test_a_stride_longer_than_the_trajectories_is_refused_before_any_work(workplace: Path) -> None:
    with pytest.raises(UsageError, match="100 steps; choose --h below 100"):
        train(workplace, "too-long", hierarchy__h=128)
    assert not (workplace / "too-long").exists()


def test_true_states_are_charged_the_bits_of_the_model_s_embeddings(workplace: Path) -> None:
    """So that device counts differ by control alone, whatever the settings would train."""
    small = settings(encoder__embedding=64)
    encoder, levels = workplace / "encoder-64", workplace / "levels-64"
    train_encoder.run(small, QUIET, dataset=workplace / "data", out=encoder)
    train_hierarchy.run(small, QUIET, dataset=workplace / "data", encoder=str(encoder), out=levels)
    model = Model.load(levels / "model.safetensors", "cpu")
    for method in ("hjepa", "hold-true", "oracle"):
        assert build_driver(method, settings(), model).bits_per_transmission == 64 * 8 + 16
    assert build_driver("oracle", settings(), None).bits_per_transmission == 256 * 8 + 16
