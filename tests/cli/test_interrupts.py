"""A second Ctrl-C ends at once and in silence; the end of a terminal is like SIGTERM."""

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from command_line import ENVIRONMENT

from hjepa_cli.compute import interrupts
from hjepa_cli.compute.interrupts import HungUp, Postponed, Terminated, sigterm_raises

# A command that waits, as a training does, and once interrupted takes its time to end.
SLOW = """
    import os, sys, time
    from hjepa_cli.cli import app
    from hjepa_cli.stages import models
    def wait(**_):
        print("ready", flush=True)
        time.sleep(60)
    models.show_list = wait
    error = app.Screen.error
    def slowly(*arguments):
        error(*arguments)
        print("told", flush=True)
        time.sleep(60)
    if "slowly" in sys.argv:
        sys.argv.remove("slowly")
        app.Screen.error = slowly
    app.main()
"""


def start(directory: Path, *words: str, before: str = "") -> subprocess.Popen[str]:
    code = textwrap.dedent(before) + textwrap.dedent(SLOW)
    pipe = subprocess.PIPE
    return subprocess.Popen(
        [sys.executable, "-c", code, "models", "list", *words],
        cwd=directory,
        env=ENVIRONMENT,
        stdout=pipe,
        stderr=pipe,
        text=True,
    )


def wait_for(child: subprocess.Popen[str], word: str) -> None:
    assert child.stdout is not None and child.stdout.readline() == f"{word}\n"


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
def test_a_signal_is_one_line_and_a_second_one_ends_at_once(tmp_path, number, code) -> None:
    with start(tmp_path, "slowly") as child:
        wait_for(child, "ready")
        child.send_signal(number)
        wait_for(child, "told")
        child.send_signal(number)
        _, said = child.communicate(timeout=60)
    assert child.returncode == code
    assert said.splitlines() == ["error: interrupted", "hint: run the same command again"]


def test_nohup_is_respected(tmp_path) -> None:
    ignoring = "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
    with start(tmp_path, before=ignoring) as child:
        wait_for(child, "ready")
        child.send_signal(signal.SIGHUP)
        with pytest.raises(subprocess.TimeoutExpired):
            child.wait(timeout=1.0)
        child.send_signal(signal.SIGTERM)
        child.communicate(timeout=60)
    assert child.returncode == 143


def test_the_end_of_a_terminal_stops_like_sigterm() -> None:
    assert issubclass(HungUp, Terminated)
    with sigterm_raises(), pytest.raises(HungUp) as hung:
        os.kill(os.getpid(), signal.SIGHUP)
        signal.pause()
    assert interrupts.exit_code(hung.value) == 129
    with sigterm_raises(), Postponed() as waiting, pytest.raises(HungUp):
        with waiting.postpone() as stopped:
            os.kill(os.getpid(), signal.SIGHUP)
            assert stopped()
            assert waiting.interrupted("", "").exit_code == 129


def test_handlers_are_given_back() -> None:
    before = [signal.getsignal(number) for number in interrupts.SIGNALS]
    with sigterm_raises(), Postponed():
        pass
    assert [signal.getsignal(number) for number in interrupts.SIGNALS] == before
