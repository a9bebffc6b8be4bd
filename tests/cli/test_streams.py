"""Streams that are closed, full or without a reader change no result and no exit code."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import ENVIRONMENT, open_shell

from hjepa_cli.core.datasets.dataset import load_dataset

FULL = "/dev/full"  # to write to, through an open descriptor: it is replaced by nothing
CLOSED = "&-"
NO_MODEL = "models info nope"


def shell(directory: Path, command: str, **streams: str) -> subprocess.CompletedProcess[bytes]:
    """Run ``hjepa COMMAND`` by a shell that redirects its streams."""
    redirected = " ".join(
        f"{2 if name == 'stderr' else 1}>{where}" for name, where in streams.items()
    )
    line = f"exec {sys.executable} -m hjepa_cli {command} {redirected}"
    run = subprocess.run(
        ["bash", "-c", line], cwd=directory, env=ENVIRONMENT, capture_output=True, check=False
    )
    assert b"Traceback" not in run.stderr and b"Exception" not in run.stderr
    return run


@pytest.mark.parametrize("command", ["models list", "models list --json", "--help", "--version"])
def test_results_that_do_not_get_out_are_one_line_and_74(tmp_path: Path, command: str) -> None:
    done = shell(tmp_path, command, stdout=FULL)
    assert done.returncode == 74
    *_, error, hint = done.stderr.decode().splitlines()
    assert error == "error: cannot write results to stdout: No space left on device"
    assert hint.startswith("hint: ")
    assert shell(tmp_path, command, stdout=FULL, stderr=FULL).returncode == 74


@pytest.mark.parametrize("flags", ["", " --json"])
@pytest.mark.parametrize("where", [FULL, CLOSED])
def test_an_error_keeps_its_code_where_it_cannot_be_told(
    tmp_path: Path, where: str, flags: str
) -> None:
    silent = shell(tmp_path, NO_MODEL + flags, stderr=where)
    assert silent.returncode == 66
    if flags:
        assert json.loads(silent.stdout)["error"]["code"] == 66  # one document, and no text in it
    else:
        assert silent.stdout == b""
    assert shell(tmp_path, NO_MODEL + flags, stdout=where, stderr=where).returncode == 66


def test_a_closed_stream_is_the_null_device(tmp_path: Path) -> None:
    assert shell(tmp_path, "models list", stdout=CLOSED).returncode == 0
    done = shell(tmp_path, "models list --json", stderr=CLOSED)
    assert done.returncode == 0 and json.loads(done.stdout)["models"]


def test_streams_that_are_none_are_the_null_device(tmp_path, monkeypatch, capsys) -> None:
    """As under pythonw, or after a daemon has closed them."""
    shell = open_shell(tmp_path, monkeypatch, capsys)
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    assert shell("--version").code == 0
    assert shell("models", "info", "nope", "--json").code == 66


def test_no_file_of_ours_is_what_a_closed_stream_was(tmp_path: Path) -> None:
    """The next file to be opened would be number 1, and C libraries write there."""
    code = (
        "import os; from hjepa_cli.output.streams import lasting_streams\n"
        "with lasting_streams(), open('shard', 'wb') as file:\n"
        "    assert file.fileno() > 2\n"
        "    os.write(1, b'from C')\n"
    )
    line = f'exec {sys.executable} -c "{code}" <&- >&-'
    subprocess.run(["bash", "-c", line], cwd=tmp_path, env=ENVIRONMENT, check=True)
    assert (tmp_path / "shard").read_bytes() == b""


def test_a_run_survives_a_full_log_disk(tmp_path: Path) -> None:
    collect = "collect --preset smoke --trajectories 2 --test-trajectories 2 --out data"
    done = shell(tmp_path, collect, stdout=FULL, stderr=FULL)
    # Its results are in files; only a result that is to go to stdout is lost there.
    assert done.returncode in (0, 74) and load_dataset(tmp_path / "data").splits
    again = shell(tmp_path, f"{collect} --json", stderr=FULL)
    assert again.returncode == 0 and json.loads(again.stdout)["dataset"] == "data"


@pytest.mark.parametrize("command", ["--help", "models list", f"{NO_MODEL} --json"])
def test_a_pipe_without_a_reader_ends_quietly(tmp_path: Path, command: str) -> None:
    read_end, write_end = os.pipe()
    os.close(read_end)
    done = subprocess.run(
        [sys.executable, "-m", "hjepa_cli", *command.split()],
        cwd=tmp_path,
        env=ENVIRONMENT,
        stdout=write_end,
        stderr=subprocess.PIPE,
        check=False,
    )
    os.close(write_end)
    assert done.returncode == (66 if "info" in command else 74)
    assert b"Traceback" not in done.stderr and b"Exception" not in done.stderr


def test_a_signal_at_the_moment_of_writing_doubles_nothing(tmp_path: Path) -> None:
    """An interrupted write of ours would leave in the buffer what is out already."""
    code = (
        "import signal, sys; from hjepa_cli.output import streams\n"
        "writing = False\n"
        "def strike(*_):\n"
        "    global writing\n"
        "    if writing:\n"  # never where nothing would catch it
        "        writing = False; 1 / 0\n"
        "with streams.lasting_streams() as out:\n"
        "    signal.signal(signal.SIGALRM, strike)\n"
        "    signal.setitimer(signal.ITIMER_REAL, 0.001, 0.0005)\n"
        "    for number in range(3000):\n"
        "        try:\n"
        "            writing = True; sys.stdout.write(f'{number};'); sys.stdout.flush()\n"
        "            writing = False\n"
        "        except ZeroDivisionError:\n"
        "            pass\n"
        "    signal.setitimer(signal.ITIMER_REAL, 0)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True
    )
    numbers = done.stdout.split(";")[:-1]
    assert len(numbers) == len(set(numbers)) and len(numbers) > 1000, done.stderr
