"""Training that is interrupted and continued ends in the bytes of training that is not."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import ENVIRONMENT, Shell, assert_one_line_error, open_shell

from hjepa_cli import plugins
from hjepa_cli.compute.interrupts import Postponed, Terminated, sigterm_raises
from hjepa_cli.config.schema import Settings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.training import progress
from hjepa_cli.core.training.batches import FrameWindows, TrajectoryBatch
from hjepa_cli.core.training.jepa import Jepa
from hjepa_cli.core.training.levels import EmbeddedTrajectories
from hjepa_cli.core.training.optimiser import Optimiser
from hjepa_cli.core.training.progress import PROGRESS_FILE
from hjepa_cli.core.training.ranks import Ranks
from hjepa_cli.errors import DataError, Interrupted, NumericalError, StorageError, UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import (
    collect,
    embedding_training,
    evaluate,
    resume,
    train_encoder,
    train_hierarchy,
)
from hjepa_cli.storage import runs
from hjepa_cli.storage.checkpoints import load_checkpoint, save_checkpoint
from hjepa_cli.storage.files import jsonable

QUIET = Screen(quiet=True)
TINY = {
    "collect.trajectories": 4,
    "collect.test_trajectories": 2,
    "collect.clean_trajectories": 2,
    "collect.steps": 20,
    "collect.clean_steps": 12,
    "protocol.horizon": 10,
    "encoder.embedding": 16,
    "encoder.hidden": 16,
    "actor.hidden": 16,
    "encoder.steps": 5,
    "encoder.batch_trajectories": 8,
    "encoder.batch_frames": 5,
    "encoder.gate": False,
    "augment.steps": 3,
    "actor.epochs": 1,
    "actor.batch": 40,
    "hierarchy.rollout_steps": 8,
    "hierarchy.batch_trajectories": 2,
    "hierarchy.coarse_steps": 3,
    "hierarchy.flat_steps": 2,
    "hierarchy.medium_steps": 2,
    "hierarchy.low_steps": 2,
}
STEPS = {"train-encoder": 5, "train-hierarchy": 12}  # of all loops of the stage

Train = Callable[[Path], dict[str, Any]]


def settings(**changes: object) -> Settings:
    return load_settings(flags=TINY | {key.replace("__", "."): v for key, v in changes.items()})


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset, and both stages trained without interruption."""
    root = tmp_path_factory.mktemp("resume")
    collect.run(settings(), QUIET, out=root / "data")
    for stage in STEPS:
        trainer(stage, root)(root / stage)
    return root


def trainer(stage: str, root: Path, **changes: object) -> Train:
    chosen = settings(**changes)
    if stage == "train-encoder":
        return lambda out: train_encoder.run(chosen, QUIET, dataset=root / "data", out=out)
    encoder = str(root / "train-encoder")
    return lambda out: train_hierarchy.run(
        chosen, QUIET, dataset=root / "data", encoder=encoder, out=out
    )


def signal_after(monkeypatch: pytest.MonkeyPatch, steps: int, number: int = signal.SIGINT) -> None:
    """Send this process a signal in the middle of a training step."""
    update, seen = Optimiser.step, 0

    def step(self: Optimiser, *rest: Any) -> float:
        nonlocal seen
        seen += 1
        if seen == steps:
            os.kill(os.getpid(), number)
        return update(self, *rest)

    monkeypatch.setattr(Optimiser, "step", step)


def crash_after(monkeypatch: pytest.MonkeyPatch, steps: int) -> None:
    """Let the step after ``steps`` fail, as a bug or a lack of memory would."""
    update, seen = Optimiser.step, 0

    def step(self: Optimiser, *rest: Any) -> float:
        nonlocal seen
        seen += 1
        if seen > steps:
            raise RuntimeError("crash")
        return update(self, *rest)

    monkeypatch.setattr(Optimiser, "step", step)


def skip_actor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fit no actor with the counted optimiser: only steps of the loops count."""
    for module in (train_encoder, embedding_training):
        fit = module.fit_actor

        def uncounted(*args: Any, fit: Any = fit, **options: Any) -> Any:
            counted, Optimiser.step = Optimiser.step, ORIGINAL_STEP  # type: ignore[method-assign]
            try:
                return fit(*args, **options)
            finally:
                Optimiser.step = counted  # type: ignore[method-assign]

        monkeypatch.setattr(module, "fit_actor", uncounted)


ORIGINAL_STEP = Optimiser.step


def assert_equal_runs(one: Path, other: Path) -> None:
    for name in ("model.safetensors", "metrics.csv", "config.toml"):
        assert (one / name).read_bytes() == (other / name).read_bytes(), name
    assert not (one / PROGRESS_FILE).exists() and not (other / PROGRESS_FILE).exists()


@pytest.mark.parametrize("stage", STEPS)
def test_interrupted_at_any_step_and_continued_is_uninterrupted(
    stage: str, workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C in every third step, at each end of a loop included, until the run ends."""
    train, out, interruptions = trainer(stage, workplace), tmp_path / "run", 0
    skip_actor(monkeypatch)
    while not (out / runs.RESULT).exists():
        with monkeypatch.context() as patched:
            signal_after(patched, 3 if interruptions % 2 else 2)
            try:
                train(out)
            except Interrupted as interrupted:
                assert interrupted.exit_code == 130
                assert interrupted.hint == f"hjepa resume {out}"
                assert "all is saved" in interrupted.message
                interruptions += 1
    assert interruptions == (2 if stage == "train-encoder" else 5)
    assert_equal_runs(out, workplace / stage)


@pytest.mark.parametrize(
    ("stage", "changes", "steps", "stopped"),
    [
        # Its directions.
        (
            "train-encoder",
            {"encoder__regulariser": "sigreg", "encoder__regulariser_weight": 1.0},
            3,
            ("jepa", 3),
        ),
        # Its pictures: after one of the three steps in which the encoder is hardened, and before.
        ("train-hierarchy", {"augment__strength": 0.5}, 10, ("hardening", 1)),
        ("train-hierarchy", {"augment__strength": 0.5}, 9, ("flat", 2)),
    ],
    ids=["sigreg", "augmentation", "before augmentation"],
)
def test_what_is_drawn_goes_on_as_it_would_have(
    stage: str,
    changes: dict[str, Any],
    steps: int,
    stopped: tuple[str, int],
    workplace: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    train = trainer(stage, workplace, **changes)
    skip_actor(monkeypatch)
    train(tmp_path / "whole")
    with monkeypatch.context() as patched:
        signal_after(patched, steps)
        with pytest.raises(Interrupted):
            train(tmp_path / "interrupted")
    saved = load_checkpoint(tmp_path / "interrupted" / PROGRESS_FILE).metadata
    assert (saved["phase"], saved["step"]) == stopped
    train(tmp_path / "interrupted")
    assert_equal_runs(tmp_path / "whole", tmp_path / "interrupted")
    plain = workplace / stage / "model.safetensors"
    assert (tmp_path / "whole" / "model.safetensors").read_bytes() != plain.read_bytes()


@pytest.mark.parametrize("stage", STEPS)
def test_a_stop_between_saves_repeats_what_was_lost(
    stage: str, workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A crash loses steps and leaves rows of metrics behind; both are made again, once.

    A hierarchy loses one in which its encoder is hardened, too.
    """
    train, out = trainer(stage, workplace), tmp_path / "run"
    every_s = iter((1e9, 0.0, 1e9))
    for steps in (1, 2, 2) if stage == "train-encoder" else (1, 10, 1):
        with monkeypatch.context() as patched:
            skip_actor(patched)
            crash_after(patched, steps)
            patched.setattr(progress, "SAVE_EVERY_S", next(every_s))
            with pytest.raises(RuntimeError, match="crash"):
                train(out)
    with open(out / runs.METRICS, "a") as rows:
        rows.write("99,left,behind\n")
    train(out)
    assert_equal_runs(out, workplace / stage)


def test_each_part_of_the_state_matters(
    workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Leave one part out and the continued run is another one: the comparison can fail."""
    parts, interrupted = Jepa.parts, tmp_path / "interrupted"
    with monkeypatch.context() as patched:
        signal_after(patched, 3)
        with pytest.raises(Interrupted):
            trainer("train-encoder", workplace)(interrupted)
    for forgotten in ("target", "inverse", "optimiser", "stream"):
        out = Path(shutil.copytree(interrupted, tmp_path / forgotten))
        with monkeypatch.context() as patched:
            saved = load_checkpoint(out / PROGRESS_FILE)
            kept = dict(saved.tensors)
            if forgotten == "optimiser":
                kept = {name: value for name, value in kept.items() if "optimiser" not in name}
                save_checkpoint(out / PROGRESS_FILE, kept, saved.metadata)
            elif forgotten == "stream":
                other = np.random.Generator(np.random.Philox(1)).bit_generator.state
                changed = saved.metadata | {"stream": jsonable(other)}
                save_checkpoint(out / PROGRESS_FILE, kept, changed)
            else:
                kept = {name: v for name, v in kept.items() if not name.startswith(forgotten)}
                save_checkpoint(out / PROGRESS_FILE, kept, saved.metadata)
                patched.setattr(
                    Jepa,
                    "parts",
                    lambda self, name=forgotten: {
                        key: part for key, part in parts(self).items() if key != name
                    },
                )
            trainer("train-encoder", workplace)(out)
        model = out / "model.safetensors"
        assert model.read_bytes() != (workplace / "train-encoder" / model.name).read_bytes()


def test_the_gpu_s_random_numbers_are_part_of_the_state(
    workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is none here: stand-ins take the place of torch's calls."""
    out, state = tmp_path / "run", torch.arange(16, dtype=torch.uint8)
    train = trainer("train-encoder", workplace, device="cpu")
    with monkeypatch.context() as patched:
        patched.setattr(torch.cuda, "is_initialized", lambda: True)
        patched.setattr(torch.cuda, "get_rng_state", lambda: state)
        signal_after(patched, 3)
        with pytest.raises(Interrupted):
            train(out)
    saved = load_checkpoint(out / PROGRESS_FILE)
    kept = {name: of for name, of in saved.tensors.items() if name != progress.CUDA_STREAM}
    older, elsewhere = (Path(shutil.copytree(out, tmp_path / name)) for name in ("older", "cpu"))
    save_checkpoint(older / PROGRESS_FILE, kept, saved.metadata)
    given: list[torch.Tensor] = []
    monkeypatch.setattr(torch.cuda, "set_rng_state", given.append)
    train(elsewhere)  # where there is no GPU
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    train(older)
    assert not given
    train(out)
    assert len(given) == 1 and torch.equal(given[0], state)


def test_the_teacher_of_hardening_is_part_of_the_state(
    workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is nothing that one could make again: the encoder has gone on."""
    out = tmp_path / "run"
    with monkeypatch.context() as patched:
        skip_actor(patched)
        signal_after(patched, 10)
        with pytest.raises(Interrupted, match=r"after step 1 of 3 \(hardening\)"):
            trainer("train-hierarchy", workplace)(out)
    saved, prefix = load_checkpoint(out / PROGRESS_FILE), "networks.teacher."
    teacher = {name: of for name, of in saved.tensors.items() if name.startswith(prefix)}
    encoder = {name: saved.tensors[name.replace("teacher", "encoder", 1)] for name in teacher}
    assert any((encoder[name] != value).any() for name, value in teacher.items())
    kept = {name: value for name, value in saved.tensors.items() if name not in teacher}
    save_checkpoint(out / PROGRESS_FILE, kept, saved.metadata)
    with pytest.raises(DataError, match="does not fit this run"):
        trainer("train-hierarchy", workplace)(out)
    stem = f"{prefix}stem.weight"
    other = {stem: -teacher[stem]}
    save_checkpoint(out / PROGRESS_FILE, {**saved.tensors, **other}, saved.metadata)
    trainer("train-hierarchy", workplace)(out)
    model = out / "model.safetensors"
    assert model.read_bytes() != (workplace / "train-hierarchy" / model.name).read_bytes()


def test_a_state_goes_on_under_its_own_settings_only(
    workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a model of both settings would claim the second."""
    out, config, environment = (
        tmp_path / name for name in ("run", "run/config.toml", "run/environment.json")
    )
    with monkeypatch.context() as patched:
        signal_after(patched, 3)
        with pytest.raises(Interrupted):
            trainer("train-encoder", workplace)(out)
    config.write_text(config.read_text().replace("seed = 0\n", "seed = 8\n"))
    with pytest.raises(DataError, match=r"config\.toml was changed .*: seed = 0, not 8"):
        resume.run(out, QUIET)
    recorded = json.loads(environment.read_text())
    assert recorded["settings"].pop("seed") == 0
    recorded["settings"]["seed"] = 8
    environment.write_text(json.dumps(recorded))  # one who changes both has the state against him
    with pytest.raises(DataError, match=rf"{PROGRESS_FILE} .*other settings: seed = 0, not 8"):
        resume.run(out, QUIET)


def test_a_state_of_an_older_version_goes_on_under_the_preset_of_its_run(tmp_path: Path) -> None:
    """What its settings had not yet is as that preset says, not as the default one."""
    smoke, path, said = load_settings("smoke"), tmp_path / "run" / PROGRESS_FILE, list[str]()

    def opened() -> progress.Progress:
        with runs.Run.create("train-encoder", path.parent, smoke.as_dict()) as record:
            return progress.Progress(record, said.append)

    assert [*opened().steps("jepa", 2, {}, np.random.default_rng(0))] == [0, 1]
    saved = load_checkpoint(path)
    del saved.metadata["settings"]["protocol"]["bootstrap"]
    assert smoke.protocol.bootstrap != load_settings().protocol.bootstrap
    save_checkpoint(path, dict(saved.tensors), saved.metadata)
    opened()
    assert said == [f"{path.parent}: jepa goes on after step 2"]


def test_the_optimiser_keeps_its_memory_layout() -> None:
    """Moments in another layout would take another code path and end in other last bits."""
    weight = torch.nn.Parameter(torch.randn(4, 3, 5, 5).to(memory_format=torch.channels_last))

    def optimiser() -> Optimiser:
        return Optimiser(
            [weight],
            name="adamw",
            schedule="constant",
            steps=9,
            learning_rate=0.1,
            weight_decay=0.1,
            gradient_clip=0.0,
        )

    first, second = optimiser(), optimiser()
    first.step((weight**2).sum(), 0)
    second.load_state_dict({name: value.contiguous() for name, value in first.state_dict().items()})
    moments = second.inner.state[weight]
    assert moments["exp_avg"].stride() == weight.stride()
    for name, value in first.inner.state[weight].items():
        assert torch.equal(moments[name], value)
    with pytest.raises(ValueError, match="optimiser state"):
        second.load_state_dict({"0.exp_avg": torch.zeros(2)})
    with pytest.raises(ValueError, match="optimiser state"):
        second.load_state_dict({"7.exp_avg": torch.zeros(4, 3, 5, 5)})


def test_saved_state_that_does_not_fit_is_refused(
    workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train, out = trainer("train-encoder", workplace), tmp_path / "run"
    with monkeypatch.context() as patched:
        skip_actor(patched)
        signal_after(patched, 1)
        with pytest.raises(Interrupted):
            train(out)
    saved = load_checkpoint(out / PROGRESS_FILE)
    for change in ("missing", "extra", "shape", "field", "bytes"):
        tensors, metadata = dict(saved.tensors), dict(saved.metadata)
        name = min(tensors)
        if change == "missing":
            del tensors[name]
        elif change == "extra":
            tensors["optimiser.9999.exp_avg"] = tensors[name]
        elif change == "shape":
            tensors[name] = tensors[name][..., :1]
        elif change == "field":
            del metadata["stream"]
        save_checkpoint(out / PROGRESS_FILE, tensors, metadata)
        if change == "bytes":
            (out / PROGRESS_FILE).write_bytes((out / PROGRESS_FILE).read_bytes()[:-1])
        with pytest.raises(DataError, match="progress") as caught:
            train(out)
        assert "\n" not in caught.value.message
    (out / PROGRESS_FILE).unlink()  # what the hint says
    train(out)
    assert_equal_runs(out, workplace / "train-encoder")


def test_a_run_keeps_its_number_of_threads(
    workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sums over two threads end in other last bits."""
    with monkeypatch.context() as patched:
        skip_actor(patched)
        signal_after(patched, 2)
        with pytest.raises(Interrupted):
            trainer("train-encoder", workplace)(tmp_path / "run")
    torch.set_num_threads(2)
    trainer("train-encoder", workplace)(tmp_path / "run")
    assert torch.get_num_threads() == 1
    assert_equal_runs(tmp_path / "run", workplace / "train-encoder")


def test_resume_needs_no_other_flag(
    workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither the dataset nor the preset; from any directory."""
    out = tmp_path / "run"
    with monkeypatch.context() as patched:
        skip_actor(patched)
        signal_after(patched, 4)
        with pytest.raises(Interrupted):
            trainer("train-hierarchy", workplace)(out)
    monkeypatch.chdir(tmp_path)
    result = resume.run(Path("run"), QUIET)
    assert_equal_runs(out, workplace / "train-hierarchy")
    assert resume.run(out, QUIET) == result  # finished: told again


def test_another_dataset_is_another_run(
    workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    with monkeypatch.context() as patched:
        signal_after(patched, 1)
        with pytest.raises(Interrupted):
            trainer("train-encoder", workplace)(out)
    collect.run(settings(seed=7), QUIET, out=tmp_path / "data")
    with pytest.raises(UsageError, match=r"dataset = ") as caught:
        train_encoder.run(settings(), QUIET, dataset=tmp_path / "data", out=out)
    assert f"hjepa resume {out}" in str(caught.value.hint)


@pytest.mark.parametrize("what", [PROGRESS_FILE, "model.safetensors", runs.RESULT])
def test_a_full_disk_loses_nothing_and_names_the_command_that_goes_on(
    what: str, workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the third save of the state, at the model, at the very last file."""
    out, replace, seen = tmp_path / "run", os.replace, 0

    def full(source: Path, target: Path) -> None:
        nonlocal seen
        seen += target.name == what
        if target.name == what and seen == (3 if what == PROGRESS_FILE else 1):
            raise OSError(28, "No space left on device")
        replace(source, target)

    with monkeypatch.context() as patched:
        patched.setattr(progress, "SAVE_EVERY_S", 0.0)
        patched.setattr(os, "replace", full)
        with pytest.raises(StorageError, match=f"cannot write .*{what}: No space left") as caught:
            trainer("train-encoder", workplace)(out)
    assert caught.value.hint == f"free some disk space, then hjepa resume {out}"
    assert not [name for name in os.listdir(out) if name.endswith(".tmp")]
    saved = load_checkpoint(out / PROGRESS_FILE).metadata["step"]
    assert saved == (2 if what == PROGRESS_FILE else 5)
    trainer("train-encoder", workplace)(out)
    assert_equal_runs(out, workplace / "train-encoder")


@pytest.mark.slow
def test_a_disk_that_really_refuses(workplace: Path, tmp_path: Path) -> None:
    """A limit on the size of files, which the kernel keeps as it keeps a quota; exit 74."""
    config = tmp_path / "config.toml"
    config.write_text(runs.to_toml(settings().as_dict()))
    limited = (
        "import resource, sys\n"
        "from hjepa_cli.cli.app import main\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))\n"
        "main(sys.argv[1:])"
    )
    words = ["train-encoder", "--dataset", workplace / "data", "--config", config, "--out", "run"]
    ended = subprocess.run(
        [sys.executable, "-c", limited, *words, "--quiet"],
        cwd=tmp_path,
        env=ENVIRONMENT | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 74, ended.stderr
    assert re.fullmatch(
        rf"error: cannot write run/{PROGRESS_FILE}: File too large\n"
        r"hint: free some disk space, then hjepa resume run\n",
        ended.stderr,
    )
    assert not [name for name in os.listdir(tmp_path / "run") if "safetensors" in name]
    resume.run(tmp_path / "run", QUIET)
    assert_equal_runs(tmp_path / "run", workplace / "train-encoder")


def test_a_long_history_outgrows_no_header(
    workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows of metrics.csv beyond what the header of a file may hold come back like any others."""
    out, rows = tmp_path / "run", "0.5," * 300_000 + "\n"
    with monkeypatch.context() as patched:
        skip_actor(patched)
        signal_after(patched, 2)
        metrics = runs.Run.metrics
        longer = property(lambda run: rows + metrics.fget(run), metrics.fset)  # type: ignore[misc]
        patched.setattr(runs.Run, "metrics", longer)
        with pytest.raises(Interrupted):
            trainer("train-encoder", workplace)(out)
    (out / runs.METRICS).unlink(missing_ok=True)
    with monkeypatch.context() as patched:
        skip_actor(patched)
        crash_after(patched, 0)
        with pytest.raises(RuntimeError, match="crash"):
            trainer("train-encoder", workplace)(out)
    assert (out / runs.METRICS).read_text().startswith(rows)


def test_a_state_whose_metrics_were_in_the_header_goes_on(
    workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As it was written at first."""
    out = tmp_path / "run"
    with monkeypatch.context() as patched:
        skip_actor(patched)
        signal_after(patched, 4)
        with pytest.raises(Interrupted):
            trainer("train-encoder", workplace)(out)
    saved = load_checkpoint(out / PROGRESS_FILE)
    tensors = dict(saved.tensors)
    text = tensors.pop(progress.METRICS_ROWS).tobytes().decode()
    assert text == (out / runs.METRICS).read_text() and text.count("\n") >= 2
    save_checkpoint(out / PROGRESS_FILE, tensors, saved.metadata | {"metrics": text})
    (out / runs.METRICS).write_text("")
    trainer("train-encoder", workplace)(out)
    assert_equal_runs(out, workplace / "train-encoder")


@pytest.mark.parametrize(
    "change",
    [
        {"step": "2"},
        {"step": -1},
        {"step": 10**9},
        {"phase": "jepb"},
        {"finished": "jepa"},
        {"threads": 0},
        {"threads": 10**9},
        {"stream": {}},
        {"stream": {"state": [2**70]}},
        {"seconds": None},
        {"metrics": 3},
    ],
    ids=str,
)
def test_a_state_that_lies_is_refused(
    change: dict[str, Any], workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sealed well, and wrong: no traceback, no other number of threads, no untrained model."""
    out, threads = tmp_path / "run", torch.get_num_threads()
    with monkeypatch.context() as patched:
        skip_actor(patched)
        signal_after(patched, 1)
        with pytest.raises(Interrupted):
            trainer("train-encoder", workplace)(out)
    saved = load_checkpoint(out / PROGRESS_FILE)
    save_checkpoint(out / PROGRESS_FILE, saved.tensors, saved.metadata | change)
    with pytest.raises(DataError, match="does not fit this run") as caught:
        trainer("train-encoder", workplace)(out)
    assert "\n" not in caught.value.message and f"rm {out}" in (caught.value.hint or "")
    assert torch.get_num_threads() == threads and not (out / "model.safetensors").exists()


def test_a_diverging_run_saves_nothing_that_is_not_finite(
    workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, total = tmp_path / "run", Jepa.total
    calls = 0

    def poisoned(self: Jepa, terms: dict[str, torch.Tensor]) -> torch.Tensor:
        nonlocal calls
        calls += 1
        return total(self, terms) * (float("nan") if calls == 3 else 1.0)

    monkeypatch.setattr(Jepa, "total", poisoned)
    monkeypatch.setattr(progress, "SAVE_EVERY_S", 0.0)
    draw, drawn = FrameWindows.draw, []

    def remember(self: FrameWindows, *rest: Any) -> TrajectoryBatch:
        drawn.append(draw(self, *rest))
        return drawn[-1]

    monkeypatch.setattr(FrameWindows, "draw", remember)
    with pytest.raises(NumericalError, match=r"diverged at step 2 .*learning rate") as caught:
        trainer("train-encoder", workplace)(out)
    assert f"batch: {drawn[2].drawn})" in caught.value.message
    assert caught.value.exit_code == 70
    assert not (out / "model.safetensors").exists()
    assert load_checkpoint(out / PROGRESS_FILE).metadata["step"] == 2


def test_a_batch_is_named_by_what_is_in_it() -> None:
    """8 windows of 4 trajectories whose pixels and actions say which they are, and when."""
    number, k = torch.arange(4)[:, None], torch.arange(10)
    frames = (16 * number + torch.arange(11)).to(torch.uint8)
    windows = FrameWindows(
        frames[..., None, None, None].expand(4, 11, 2, 2, 3),
        (100 * number + k).float(),
        window_frames=3,
        stride=2,
        mirror=False,
    )
    batch = windows.draw(8, np.random.default_rng(0))
    first = batch.frames.unflatten(0, (8, 3))[:, 0, 0, 0, 0, 0].tolist()
    named = re.findall(r"(\d+) from k = (\d+)", batch.drawn)
    assert [16 * int(row) + int(start) for row, start in named] == first
    assert len(set(named)) > 4


@pytest.mark.parametrize("level", ["high", "medium", "low", "flat"])
def test_the_levels_name_their_batches_too(
    level: str, workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[list[int]] = []
    choose, add_up = EmbeddedTrajectories.choose, Ranks.add_up
    loops = dict(zip(("high", "medium", "low", "flat"), (1, 4, 6, 8), strict=True))

    def remember(self: EmbeddedTrajectories, *rest: Any) -> torch.Tensor:
        seen.append(choose(self, *rest).tolist())
        return torch.tensor(seen[-1])

    def poison(self: Ranks, tensors: list[torch.Tensor]) -> None:
        add_up(self, tensors)
        if len(seen) > loops[level]:
            tensors[0].fill_(float("nan"))

    monkeypatch.setattr(EmbeddedTrajectories, "choose", remember)
    monkeypatch.setattr(Ranks, "add_up", poison)
    with pytest.raises(NumericalError) as caught:
        trainer("train-hierarchy", workplace)(tmp_path / "run")
    *_, drawn, again = seen
    assert drawn == again and len(seen) == loops[level] + 2
    listed = ", ".join(map(str, drawn))
    views = 8 * (1 + settings().hierarchy.shifted_copies)
    named = f"of {views} (shifted and mirrored copies last) the trajectories {listed})"
    assert caught.value.message.endswith(named)
    assert (tmp_path / "run" / PROGRESS_FILE).exists() == (level != "high")


def test_signals_inside_and_outside_of_loops() -> None:
    with Postponed() as interrupts:
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        with interrupts.postpone() as stopped:
            assert not stopped()
            signal.raise_signal(signal.SIGTERM)
            assert stopped()
            assert interrupts.interrupted("x", "y").exit_code == 143
            with pytest.raises(KeyboardInterrupt):  # the second one stops at once
                signal.raise_signal(signal.SIGINT)
            interrupts._signal = None
        with pytest.raises(Terminated), interrupts.postpone():
            signal.raise_signal(signal.SIGTERM)  # after the loop's last look
    with sigterm_raises(), pytest.raises(Terminated):
        signal.raise_signal(signal.SIGTERM)


@pytest.fixture
def hjepa(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Shell:
    return open_shell(tmp_path, monkeypatch, capsys)


STAGES = ("train-encoder", "train-hierarchy", "eval", "scale", "reproduce")


@pytest.mark.parametrize("stage", STAGES)
def test_a_dry_run_says_what_is_taken_up_and_takes_up_nothing(hjepa: Shell, stage: str) -> None:
    settings = load_settings("smoke", flags={"seed": 3})
    models = evaluate.open_measurable(settings, QUIET, None, None)
    taken = plugins.STAGES[stage].inputs
    given = {"dataset": None, **models.inputs(remeasure=False)}
    inputs = {name: value for name, value in given.items() if name.partition(" ")[0] in taken}
    with runs.Run.create(stage, Path("r"), settings.as_dict(), inputs):
        pass
    with hjepa.untouched():
        plan = hjepa("resume", "r", "--dry-run", "--json").document["plan"]
    flags = () if stage == "reproduce" else ("--out", "r")
    again = hjepa(stage, "--preset", "smoke", "--dry-run", "--json", *flags).document["plan"]
    assert plan["work"] == [
        "go on where it was interrupted; from the start it would",
        *again["work"],
    ]
    assert plan["command"] == "resume r" and plan["seconds"] == again["seconds"]
    with runs.Run.create(stage, Path("r"), settings.as_dict(), inputs) as record:
        record.finish({})
    assert "r, which is finished" in hjepa("resume", "r", "--dry-run").out


def test_what_cannot_be_resumed(hjepa: Shell) -> None:
    assert_one_line_error(hjepa("resume", "gone"), 66, "run gone does not exist")
    (hjepa.directory / "empty").mkdir()
    assert_one_line_error(hjepa("resume", "empty"), 66, "not a run directory")
    run = hjepa.directory / "run"
    run.mkdir()
    (run / "config.toml").write_text("")
    for text, code, message in (
        ("{", 65, "not valid JSON"),
        ('{"schema": 4, "stage": "eval", "inputs": {}}', 65, "reads up to 3"),
        ('{"schema": 3, "stage": "eval", "inputs": {}}', 65, "malformed"),
        ('{"schema": 2, "stage": "eval", "inputs": []}', 65, "malformed"),
        ('{"schema": 2, "stage": "eval", "inputs": {}, "preset": 3}', 65, "preset"),
        ('{"schema": 2, "stage": "dance", "inputs": {}}', 65, "'dance'"),
        ('{"stage": "eval", "preset": "nonsense"}', 2, "nonsense"),
    ):
        (run / "environment.json").write_text(text)
        assert_one_line_error(hjepa("resume", "run"), code, message)


def test_a_run_of_another_version_says_so(hjepa: Shell) -> None:
    """Settings that this version lacks: what to do; the same settings: a note, and it goes on."""
    assert hjepa("eval", "--preset", "smoke", "--methods", "hold-true", "--out", "r").code == 0
    Path("r/result.json").unlink()
    environment = json.loads(Path("r/environment.json").read_text())
    environment["versions"]["hjepa"] = "9.8.7"
    theirs = environment["settings"] | {"quantum": {"leap": 1}}
    Path("r/environment.json").write_text(json.dumps(environment | {"settings": theirs}))
    known = Path("r/config.toml").read_text()
    Path("r/config.toml").write_text(known + "\n[quantum]\nleap = 1\n")
    with hjepa.untouched():
        outcome = hjepa("resume", "r")
    assert_one_line_error(
        outcome, 2, "made by hjepa 9.8.7", "quantum", "anew: hjepa eval --checkpoint"
    )
    Path("r/config.toml").write_text(known)
    Path("r/environment.json").write_text(json.dumps(environment))
    outcome = hjepa("resume", "r")
    assert outcome.code == 0 and "begun by hjepa 9.8.7" in outcome.err


def test_a_batch_system_ends_a_run_the_same_way(
    workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    signal_after(monkeypatch, 1, signal.SIGTERM)
    with pytest.raises(Interrupted, match="all is saved") as caught:
        trainer("train-encoder", workplace)(tmp_path / "run")
    assert caught.value.exit_code == 143


def test_a_real_process_saves_and_says_how_to_go_on(workplace: Path, tmp_path: Path) -> None:
    """Ctrl-C from outside, a second process kept out, and the printed command."""
    stage = [
        sys.executable,
        "-m",
        "hjepa_cli",
        "train-encoder",
        "--dataset",
        str(workplace / "data"),
    ]
    config = tmp_path / "config.toml"
    config.write_text(runs.to_toml(settings(encoder__steps=100_000).as_dict()))
    command = [*stage, "--config", str(config), "--out", "run"]
    environment = ENVIRONMENT | {"OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True
    ) as child:
        rows = tmp_path / "run" / "metrics.csv"
        while child.poll() is None and not (rows.exists() and rows.stat().st_size):
            time.sleep(0.05)  # until it trains
        second = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True)
        assert second.returncode == 75, second
        child.send_signal(signal.SIGINT)
        _, errors = child.communicate(timeout=600)
    assert child.returncode == 130, errors
    assert "all is saved" in errors and "hint: hjepa resume run\n" in errors
    saved = load_checkpoint(tmp_path / "run" / PROGRESS_FILE).metadata
    assert f"after step {saved['step']} of 100000" in errors
    assert json.loads((tmp_path / "run" / runs.ENVIRONMENT).read_text())["inputs"]["dataset"]
