"""Running the command line inside the test process, the way the shell would."""

import contextlib
import dataclasses
import io
import json
import os
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from hjepa_cli.cli import builder, execution
from hjepa_cli.cli.app import main

ROOT = Path(__file__).parents[1]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "HJEPA_DEBUG": "0"}  # for child processes

# The command line in a child that has no privilege over files: not even root passes permissions.
UNPRIVILEGED = """
import ctypes, os, sys
if os.geteuid() == 0:
    libc = ctypes.CDLL(None, use_errno=True)
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)
    sets = (ctypes.c_uint32 * 6)()  # effective, permitted, inheritable: twice 32
    assert libc.capget(header, sets) == 0
    for part in range(2):
        sets[part] &= ~0b110  # CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH
    assert libc.capset(header, sets) == 0
from hjepa_cli.cli.app import main
main(sys.argv[1:])
"""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What the shell sees of one command."""

    code: int
    out: str
    err: str

    @property
    def document(self) -> Any:
        """The one JSON document on stdout."""
        assert self.out.endswith("}\n") and self.out.count("\n") == 1
        return json.loads(self.out, parse_constant=lambda name: pytest.fail(f"{name} in JSON"))


class Shell:
    """Calls ``hjepa ARGUMENTS`` in an empty directory."""

    def __init__(self, directory: Path, capture: pytest.CaptureFixture[str]) -> None:
        self.directory = directory
        self._capture = capture

    def __call__(self, *arguments: str | Path) -> Outcome:
        self._capture.readouterr()
        with pytest.raises(SystemExit) as stop:
            main([str(argument) for argument in arguments])
        captured = self._capture.readouterr()
        return Outcome(int(stop.value.code or 0), captured.out, captured.err)

    def files(self) -> dict[str, bytes | None]:
        """Everything below the directory: contents of files, ``None`` for directories."""
        return {
            str(path.relative_to(self.directory)): path.read_bytes() if path.is_file() else None
            for path in sorted(self.directory.rglob("*"))
        }

    @contextlib.contextmanager
    def untouched(self) -> Iterator[None]:
        """Assert that nothing below the directory is created, changed or removed."""
        before = self.files()
        yield
        assert self.files() == before


def open_shell(
    directory: Path, monkeypatch: pytest.MonkeyPatch, capture: pytest.CaptureFixture[str]
) -> Shell:
    """Return a command line in ``directory``, 80 columns wide."""
    monkeypatch.chdir(directory)
    monkeypatch.delenv("HJEPA_DEBUG", raising=False)
    monkeypatch.setenv("COLUMNS", "80")
    return Shell(directory, capture)


def block(page: str, word: str) -> str:
    """The first block of Python of a page of the documentation that has a word in it."""
    (path,) = (ROOT / "docs").rglob(page)
    text = path.read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    return next(code for code in blocks if word in code)


def commands_in(hint: str) -> Iterator[list[str]]:
    """Yield the commands that a hint names whole, without the words around them."""
    ends = r"(?=[,;)] |[,;)]?$| (?:shows|continues|goes on|where|with|or|and|in) )"
    for found in re.finditer(rf"(?:^|[ :(])hjepa (\S.*?){ends}", hint):
        words = shlex.split(found[1])
        if not {"...", "…"} & {*words} and not words[0][0].isdigit():  # a version is no command
            yield [f"{word.lower()}.x" if word.isupper() else word for word in words]


def follow(hint: str) -> None:
    """Fail where a hint names a command that would be refused before it begins.

    ``hjepa resume`` is planned for real: what it needs must be there.
    """
    for words in commands_in(hint):
        really = words[0] == "resume" and "--plugin" not in words
        call = execution.execute if really else (lambda command, given: None)
        words = [*words, "--dry-run", "--quiet"] if really else words
        with pytest.MonkeyPatch.context() as patched, contextlib.redirect_stdout(io.StringIO()):
            patched.setattr(builder, "execute", call)
            try:
                get_command(builder.build()).main(words, "hjepa", standalone_mode=False)
            except Exception as error:
                pytest.fail(f"hint '{hint}': hjepa {shlex.join(words)}: {error!r}")


def assert_one_line_error(outcome: Outcome, code: int, *fragments: str) -> None:
    """One line that says what was wrong, at most one that says what to do, and nothing else.

    Commands in what it says to do are such that they can be followed.
    """
    assert outcome.code == code, outcome
    lines = outcome.err.splitlines()
    assert lines and lines[0].startswith("error: "), outcome
    assert len(lines) == 2 and lines[1].startswith("hint: "), outcome
    assert outcome.out == "" and "Traceback" not in outcome.err
    follow(lines[1].removeprefix("hint: "))
    for fragment in fragments:
        assert fragment in outcome.err, f"{fragment!r} is not in {outcome.err!r}"
