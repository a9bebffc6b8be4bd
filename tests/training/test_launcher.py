"""What torchrun tells a process may be wrong or missing, and its peers may never come."""

import os
import signal
import socket
import threading
import time
from collections.abc import Iterator

import pytest
from command_line import Shell, assert_one_line_error, open_shell

from hjepa_cli.compute.interrupts import Terminated, sigterm_raises
from hjepa_cli.core.training import ranks
from hjepa_cli.errors import UsageError

GOOD = {
    "TORCHELASTIC_RUN_ID": "x",
    "WORLD_SIZE": "2",
    "LOCAL_WORLD_SIZE": "2",
    "RANK": "0",
    "LOCAL_RANK": "0",
    "MASTER_ADDR": "127.0.0.1",
    "MASTER_PORT": "29511",
}


@pytest.fixture
def hjepa(tmp_path, monkeypatch, capsys) -> Shell:
    return open_shell(tmp_path, monkeypatch, capsys)


@pytest.mark.parametrize("command", ["--version", "models list", "train-encoder"])
@pytest.mark.parametrize(
    ("name", "value"),
    [(name, None) for name in GOOD if name != "TORCHELASTIC_RUN_ID"]
    + [("WORLD_SIZE", "two"), ("WORLD_SIZE", "0"), ("RANK", "2"), ("RANK", "-1"), ("RANK", "")]
    + [("LOCAL_RANK", "9"), ("MASTER_PORT", "99999"), ("MASTER_ADDR", ""), ("RANK", "²")],
)
def test_a_variable_that_is_wrong_is_named(hjepa, monkeypatch, name, value, command) -> None:
    for key, good in GOOD.items():
        monkeypatch.setenv(key, good)
    monkeypatch.delenv(name) if value is None else monkeypatch.setenv(name, value)
    assert_one_line_error(hjepa(*command.split()), 2, name, "torchrun")


def test_other_variables_of_the_kind_mean_nothing_without_torchrun(hjepa, monkeypatch) -> None:
    """Batch systems set some of them too."""
    monkeypatch.setenv("WORLD_SIZE", "two")
    monkeypatch.setenv("RANK", "1")
    assert hjepa("--version").code == 0


@pytest.fixture
def alone(monkeypatch) -> Iterator[int]:
    """A process whose peer never comes; the port."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port = int(found.getsockname()[1])
    for key, good in (GOOD | {"MASTER_PORT": str(port)}).items():
        monkeypatch.setenv(key, good)
    monkeypatch.setattr(ranks, "QUIET_S", 0.1)
    yield port


@pytest.mark.parametrize("rank", [0, 1])
@pytest.mark.parametrize(
    ("number", "error"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)]
)
def test_a_peer_that_never_comes_is_waited_for_aloud_and_interruptibly(
    alone, capfd, rank, number, error
) -> None:
    threading.Timer(1.0, os.kill, (os.getpid(), number)).start()
    began_s = time.monotonic()
    with sigterm_raises(), pytest.raises(error):
        ranks._meet(rank, 2)
    assert time.monotonic() - began_s < 30
    assert f"process {rank}: waiting for 2 processes at 127.0.0.1:{alone}" in capfd.readouterr().err


def test_a_port_that_is_taken_is_named(alone) -> None:
    with socket.socket() as taken:
        taken.bind(("", alone))
        taken.listen()
        with pytest.raises(UsageError, match=f"MASTER_PORT = {alone}"):
            ranks._meet(0, 2)


def test_who_waits_too_long_says_for_whom(alone, monkeypatch) -> None:
    monkeypatch.setattr(ranks, "TIMEOUT", ranks.datetime.timedelta(seconds=0.2))
    with pytest.raises(UsageError, match="2 processes did not all come"):
        ranks._meet(1, 2)
