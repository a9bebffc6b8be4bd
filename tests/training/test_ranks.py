"""One training on several processes: the result of one process, or one clear word of what failed.

Real processes over gloo. They are forked from a server that has torch imported; one test pays for
``torchrun`` itself.
"""

import csv
import dataclasses
import json
import multiprocessing
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import ENVIRONMENT, assert_one_line_error, open_shell
from test_resume import QUIET, TINY, one_thread  # noqa: F401

from hjepa_cli.cli.app import main
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.networks.encoder import Encoder
from hjepa_cli.core.networks.model import build_modules, tensors_of
from hjepa_cli.core.training import progress, shared_norm
from hjepa_cli.core.training.jepa import Jepa
from hjepa_cli.core.training.optimiser import Optimiser
from hjepa_cli.core.training.ranks import Ranks, joined
from hjepa_cli.core.training.shared_norm import SharedBatchNorm, share_statistics
from hjepa_cli.stages import collect, train_encoder
from hjepa_cli.storage import runs
from hjepa_cli.storage.checkpoints import Checkpoint, load_checkpoint

# On one process torch's batch norm adds up channels-last maps one number after the other, which
# costs it two digits of a variance; the order of the sums over processes is nothing beside it.
TOLERANCE, VARIANCE_TOLERANCE = 3e-5, 1e-4  # of four frames
EXACT_TOLERANCE = 2e-6  # with our batch norm on one process too: some roundings of 6e-8
# Adam divides by the gradient's size: where that is nothing but rounding (a bias before a batch
# norm), it moves the parameter by a whole learning rate. Plain SGD leaves all of them comparable.
SETTINGS = load_settings(
    flags=TINY
    | {
        "encoder.precision": "fp32",
        "encoder.optimizer": "sgd",
        "encoder.schedule": "constant",
        "encoder.learning_rate": 3e-3,
        "encoder.steps": 4,
    }
)
ADAM = dataclasses.replace(
    SETTINGS, encoder=dataclasses.replace(SETTINGS.encoder, optimizer="adamw")
)

TERMS = ("prediction", "inverse_dynamics")
Prepare = Callable[[int], None]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset, settings, and what one process makes of them."""
    root = tmp_path_factory.mktemp("ranks")
    collect.run(SETTINGS, QUIET, out=root / "data")
    for name, settings in (("sgd", SETTINGS), ("adam", ADAM)):
        (root / f"{name}.toml").write_text(runs.to_toml(settings.as_dict()))
        train_encoder.run(settings, QUIET, dataset=root / "data", out=root / name)
    with pytest.MonkeyPatch.context() as patch:  # one process with the batch norm of several
        patch.setattr(shared_norm, "summed", lambda here: here)
        patch.setattr(train_encoder, "Jepa", jepa_of_shared_norms)
        train_encoder.run(SETTINGS, QUIET, dataset=root / "data", out=root / "exact")
    return root


def jepa_of_shared_norms(encoder: Encoder, *rest: Any, **options: Any) -> Jepa:
    share_statistics(encoder)
    return Jepa(encoder, *rest, **options)


def environment(rank: int, size: int, port: int) -> dict[str, str]:
    """What torchrun sets."""
    numbers = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": size, "LOCAL_WORLD_SIZE": size}
    return {
        **{name: str(value) for name, value in numbers.items()},
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
        "TORCHELASTIC_RUN_ID": "test",
    }


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def one_process(
    rank: int, size: int, port: int, root: Path, words: list[str], prepare: Prepare | None
) -> None:
    """The target of a child: the command line as one of several processes."""
    os.chdir(root)
    os.environ |= environment(rank, size, port)
    for descriptor, name in ((1, "out"), (2, "err")):
        file = os.open(f"{rank}.{name}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, descriptor)
    sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)
    torch.set_num_threads(1)
    if prepare:
        prepare(rank)
    main(words)


def start(
    root: Path, words: list[str], size: int = 2, prepare: Prepare | None = None
) -> list[BaseProcess]:
    context, port = multiprocessing.get_context("forkserver"), free_port()
    context.set_forkserver_preload(["hjepa_cli.stages.train_encoder", "torch._dynamo"])
    started = [
        context.Process(target=one_process, args=(rank, size, port, root, words, prepare))
        for rank in range(size)
    ]
    for process in started:
        process.start()
    return started


def run(root: Path, *words: str, size: int = 2, prepare: Prepare | None = None) -> list[int | None]:
    """Exit codes of a command on ``size`` processes."""
    started = start(root, list(words), size, prepare)
    for process in started:
        process.join(900)
    return [process.exitcode for process in started]


def train(root: Path, name: str, out: str, **options: object) -> list[int | None]:
    words = ("train-encoder", "--dataset", "data", "--config", f"{name}.toml", "--out", out)
    return run(root, *words, "--quiet", **options)  # type: ignore[arg-type]


def said(root: Path, rank: int) -> str:
    return (root / f"{rank}.out").read_text() + (root / f"{rank}.err").read_text()


def losses(run_directory: Path) -> np.ndarray:
    """Both terms, at the end of every epoch."""
    with open(run_directory / "metrics.csv", newline="") as lines:
        rows = list(csv.DictReader(lines))
    return np.array([[float(row[f"loss_{term}"]) for term in TERMS] for row in rows])


def model(run_directory: Path) -> Checkpoint:
    return load_checkpoint(run_directory / "model.safetensors")


def assert_close_runs(one: Path, other: Path, tolerance: float, of_variances: float) -> None:
    """Every tensor and every loss."""
    ours, theirs = model(one).tensors, model(other).tensors
    assert ours.keys() == theirs.keys()
    for name, values in theirs.items():
        allowed = of_variances if name.endswith("running_var") else tolerance
        np.testing.assert_allclose(ours[name], values, rtol=allowed, atol=allowed, err_msg=name)
    assert len(losses(one)) == 2
    np.testing.assert_allclose(losses(one), losses(other), rtol=tolerance, atol=tolerance)


def assert_trained_as_one(several: Path) -> None:
    """As one process as it is; and much closer as one with the same batch norm.

    Also beside how far training moved the weights, which was not far.
    """
    place = several.parent
    assert_close_runs(several, place / "sgd", TOLERANCE, VARIANCE_TOLERANCE)
    assert_close_runs(several, place / "exact", EXACT_TOLERANCE, EXACT_TOLERANCE)
    exact = model(place / "exact")
    torch.manual_seed(SETTINGS.seed)
    start = tensors_of(build_modules(exact.metadata["architecture"]))
    weights = [name for name in start if name.endswith("weight")]
    moved, apart = (
        sum(float(np.square(exact.tensors[name] - other[name]).sum()) for name in weights) ** 0.5
        for other in (start, model(several).tensors)
    )
    assert apart < 1e-3 * moved


# Threads of the process group that are left when Python ends make some of its ends abort.
LAST_THREADS = """
import atexit, os, pathlib

def tell():
    tasks = pathlib.Path("/proc/self/task").iterdir()
    names = [task.joinpath("comm").read_text() for task in tasks]
    pathlib.Path("threads-" + os.environ["RANK"]).write_text("".join(names))

if "RANK" in os.environ and os.path.exists("/proc/self/task"):
    atexit.register(tell)
"""


@pytest.mark.slow
def test_torchrun_trains_what_one_process_trains(place: Path) -> None:
    """The command of the documentation, word for word but for --config."""
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2"]
    command += ["--master-port", str(free_port()), "-m", "hjepa_cli", "train-encoder"]
    command += ["--dataset", "data", "--config", "sgd.toml", "--out", "torchrun", "--json"]
    (place / "sitecustomize.py").write_text(LAST_THREADS)
    environment = {**ENVIRONMENT, "PYTHONPATH": os.pathsep.join([str(place), *sys.path])}
    ended = subprocess.run(
        command, cwd=place, env=environment, capture_output=True, text=True, timeout=900
    )
    assert ended.returncode == 0, ended.stderr
    for rank in range(2 if Path("/proc/self/task").exists() else 0):
        assert "gloo" not in (place / f"threads-{rank}").read_text()
    assert json.loads(ended.stdout)["checkpoint"] == "torchrun/model.safetensors"
    assert ended.stderr.count("run torchrun") == 1  # only the first process speaks
    assert_trained_as_one(place / "torchrun")
    assert model(place / "torchrun").metadata.keys() == model(place / "sgd").metadata.keys()


def test_shares_may_differ(place: Path) -> None:
    """8 windows on 3 processes."""
    assert train(place, "sgd", "three", size=3) == [0, 0, 0]
    assert_trained_as_one(place / "three")
    assert said(place, 1) == said(place, 2) == ""
    assert said(place, 0).endswith("three/model.safetensors\n")


def kill_second(rank: int) -> None:
    """Let process 1 die in its third step; every step before is saved."""
    progress.SAVE_EVERY_S = 0.0
    update, steps = Optimiser.step, 0

    def step(self: Optimiser, *rest: object) -> float:
        nonlocal steps
        steps += 1
        if rank == 1 and steps == 3:
            os.kill(os.getpid(), signal.SIGKILL)
        return update(self, *rest)  # type: ignore[arg-type]

    Optimiser.step = step  # type: ignore[method-assign]


@pytest.mark.slow
def test_a_killed_process_ends_the_others_and_the_run_goes_on(place: Path) -> None:
    assert train(place, "adam", "whole") == [0, 0]
    assert train(place, "adam", "killed", prepare=kill_second) == [70, -signal.SIGKILL]
    assert re.fullmatch(
        r"error: process 0 of 2 has lost the others: .*\n"
        r"hint: torchrun --nproc-per-node 2 -m hjepa_cli resume killed\n",
        said(place, 0),
    )
    assert run(place, "resume", "killed", "--quiet") == [0, 0]
    for name in ("model.safetensors", "metrics.csv"):
        assert (place / "killed" / name).read_bytes() == (place / "whole" / name).read_bytes()


def stop_second(rank: int) -> None:
    """Let process 1 alone get SIGTERM in its second step."""
    update, steps = Optimiser.step, 0

    def step(self: Optimiser, *rest: object) -> float:
        nonlocal steps
        steps += 1
        if rank == 1 and steps == 2:
            os.kill(os.getpid(), signal.SIGTERM)
        return update(self, *rest)  # type: ignore[arg-type]

    Optimiser.step = step  # type: ignore[method-assign]


def test_all_stop_after_the_same_step_and_one_process_can_go_on(place: Path) -> None:
    assert train(place, "sgd", "stopped", prepare=stop_second) == [143, 143]
    assert "after step 2 of 4" in said(place, 0) and said(place, 1) == ""
    assert load_checkpoint(place / "stopped" / progress.PROGRESS_FILE).metadata["step"] == 2
    train_encoder.run(SETTINGS, QUIET, dataset=place / "data", out=place / "stopped")
    assert_close_runs(place / "stopped", place / "sgd", TOLERANCE, VARIANCE_TOLERANCE)
    again = run(place, "resume", "stopped", "--quiet")  # finished: told again, by one
    assert again == [0, 0] and said(place, 1) == "" and "gate" in said(place, 0)


def elsewhere(rank: int) -> None:
    """Process 1 is on a machine without the dataset."""
    if rank == 1:
        Path("elsewhere").mkdir(exist_ok=True)
        Path("elsewhere", "adam.toml").write_bytes(Path("adam.toml").read_bytes())
        os.chdir("elsewhere")


def test_what_fails_on_one_process_alone_is_said_by_it(place: Path) -> None:
    assert train(place, "adam", "partly", prepare=elsewhere) == [66, 66]
    assert said(place, 1).startswith("error: process 1 of 2: dataset data does not exist\nhint: ")
    assert said(place, 0).startswith("error: process 1 of 2 cannot take part\nhint: ")
    assert not (place / "partly").exists()


def test_what_fails_on_all_is_said_once(place: Path) -> None:
    assert run(place, "train-encoder", "--dataset", "gone", "--quiet") == [66, 66]
    assert said(place, 0).startswith("error: dataset gone does not exist") and said(place, 1) == ""
    with runs.files.lock_directory(place / "adam"):
        assert train(place, "adam", "adam") == [75, 75]
    assert "another process is working" in said(place, 0) and said(place, 1) == ""


def test_processes_must_see_the_same(place: Path) -> None:
    """A saved state that only the first one sees would let them train different networks."""
    assert train(place, "sgd", "unshared", prepare=stop_second) == [143, 143]
    assert train(place, "sgd", "unshared", prepare=without_state) == [65, 65]
    assert "do not see the same" in said(place, 0)


def without_state(rank: int) -> None:
    if rank == 1:
        progress.PROGRESS_FILE = "elsewhere.safetensors"


def test_batch_norm_of_several_processes_is_that_of_one() -> None:
    context, ports = multiprocessing.get_context("forkserver"), [free_port() for _ in range(4)]
    children = [context.Process(target=check_batch_norm, args=(rank, ports)) for rank in range(2)]
    for child in children:
        child.start()
    for child in children:
        child.join(900)
    assert [child.exitcode for child in children] == [0, 0]


def check_batch_norm(rank: int, ports: list[int]) -> None:
    """Values, gradients and running statistics against torch's own, on unequal shares.

    Every meeting has a port of its own: whoever is early would meet at the one before.
    """
    torch.set_num_threads(1)
    torch.manual_seed(0)
    for kind, shape in ((torch.nn.BatchNorm2d, (7, 3, 4, 5)), (torch.nn.BatchNorm1d, (7, 3))):
        x, weights = 5 + 3 * torch.randn(shape), torch.randn(shape)
        for affine in (True, False):
            whole = torch.nn.Sequential(kind(3, affine=affine))
            if affine:
                torch.nn.init.normal_(whole[0].weight)
            shared = torch.nn.Sequential(kind(3, affine=affine))
            shared.load_state_dict(whole.state_dict())
            share_statistics(shared)
            assert isinstance(shared[0], SharedBatchNorm)
            full = x.clone().requires_grad_()
            y = whole(full)
            (y * weights).sum().backward()
            os.environ |= environment(rank, 2, ports.pop())
            with joined(torch.device("cpu"), 7) as ranks:
                rows = ranks.share(7)
                part = x[rows].clone().requires_grad_()
                y_part = shared(part)
                (y_part * weights[rows]).sum().backward()
                gradients = [value.grad for value in shared.parameters()]
                if gradients:
                    ranks.add_up(gradients)
            torch.testing.assert_close(y_part, y[rows])
            torch.testing.assert_close(part.grad, full.grad[rows], rtol=1e-4, atol=1e-5)
            for ours, theirs in zip(gradients, whole.parameters(), strict=True):
                torch.testing.assert_close(ours, theirs.grad, rtol=1e-4, atol=1e-5)
            for name, value in whole.state_dict().items():
                torch.testing.assert_close(shared.state_dict()[name], value)
            torch.testing.assert_close(shared.eval()(x), whole.eval()(x))


def test_shares_cover_everything_once() -> None:
    for size in range(1, 12):
        shares = [range(100)[Ranks(rank, size).share(10)] for rank in range(size)]
        assert [index for share in shares for index in share] == list(range(10))
        lengths = {len(share) for share in shares}
        assert max(lengths) - min(lengths) <= 1


def test_commands_that_are_not_shared_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shell = open_shell(tmp_path, monkeypatch, capsys)
    for name, value in environment(0, 2, 1).items():
        monkeypatch.setenv(name, value)
    for command in (["collect"], ["eval"], ["train-hierarchy"], ["reproduce"]):
        assert_one_line_error(shell(*command, "--quiet"), 2, "torchrun", "--workers")
    for name, value in environment(0, 11, 1).items():
        monkeypatch.setenv(name, value)
    refused = shell("train-encoder", "--quiet")
    assert_one_line_error(refused, 2, "11 processes cannot share a batch of 10 windows")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    for name, value in environment(0, 2, 1).items():
        monkeypatch.setenv(name, value)
    refused = shell("train-encoder", "--quiet")
    assert_one_line_error(refused, 2, "2 processes on a machine with 1 GPUs", "--nproc-per-node 1")
    monkeypatch.setenv("RANK", "1")
    silent = shell("train-encoder", "--quiet")
    assert (silent.code, silent.out, silent.err) == (2, "", "")
    assert shell.files() == {}
