"""The program starts here: errors become one line and an exit code, whatever the command.

Nothing heavy is imported here: a command imports its stage when it runs, so that ``--help`` answers
at once.
"""

import contextlib
import io
import os
import sys
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn, TextIO

import typer
from typer.main import get_command

from hjepa_cli.cli.builder import build
from hjepa_cli.cli.execution import PipeClosed
from hjepa_cli.compute import torchrun
from hjepa_cli.errors import DataError, HjepaError, StorageError, UsageError
from hjepa_cli.output.screen import Screen, one_line
from hjepa_cli.plugins import load_file


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the program and exit: the only place where an error becomes a line and a code.

    The arguments are those of the process, without the program's name, unless others are given.
    """
    argv = list(sys.argv[1:] if arguments is None else arguments)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # an ASCII-only terminal gets "?", not a crash
            stream.reconfigure(errors="replace")
    errors = sys.stderr
    with contextlib.ExitStack() as streams:
        if torchrun.follows():
            nowhere = streams.enter_context(open(os.devnull, "w"))
            for redirect in (contextlib.redirect_stdout, contextlib.redirect_stderr):
                streams.enter_context(redirect(nowhere))
        code = _run_command(argv, errors)
    sys.exit(code)


def _run_command(argv: list[str], errors: TextIO) -> int:
    """Run one command; return the exit code after reporting any error to ``errors``."""
    app = None
    try:
        for path in _plugins(argv):  # one may add a command
            load_file(path)
        app = build()
        returned = get_command(app).main(argv, prog_name="hjepa", standalone_mode=False)
        return returned if isinstance(returned, int) else 0
    except Exception as error:  # the last resort of a command line
        if "--debug" in argv or os.environ.get("HJEPA_DEBUG", "0") not in ("", "0"):
            traceback.print_exc()
        failure = _expected(error, argv, app)
    if isinstance(failure, PipeClosed):  # keep Python from complaining about its last flush
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return failure.exit_code
    if torchrun.follows() and not isinstance(failure, torchrun.OneOfSeveral):
        return failure.exit_code  # the process that leads says the same
    screen = Screen(json="--json" in argv, stderr=errors)
    screen.error(failure.message, failure.hint)
    if screen.json:
        message, hint = one_line(failure.message), failure.hint
        screen.emit({"error": {"code": failure.exit_code, "message": message, "hint": hint}})
    return failure.exit_code


def _plugins(argv: Sequence[str]) -> Iterator[Path]:
    """Yield the files that ``--plugin`` names anywhere on a command line."""
    words = iter(argv)
    for word in words:
        flag, sign, path = word.partition("=")
        if flag == "--plugin" and (path := path if sign else next(words, "")):
            yield Path(path)


def _expected(error: Exception, argv: list[str], app: typer.Typer | None) -> HjepaError:
    """Return an exception as one of ours: a message, a hint and an exit code."""
    named: list[str] = []
    group: Any = get_command(app) if app else None
    for word in argv:
        if word in (inside := getattr(group, "commands", {})):
            named.append(word)
            group = inside[word]
    choices = f"commands: {', '.join(getattr(group, 'commands', {}))}"
    usage = f"hjepa {' '.join(named)} --help" if named else choices
    if isinstance(error, HjepaError):
        if error.hint is None:
            again = "restore the file or make it again; what this command reads: "
            error.hint = again + usage if isinstance(error, DataError) else usage
        return error
    if hasattr(error, "format_message"):  # Typer's usage errors; it has no public base class
        return UsageError(" ".join(error.format_message().split()), hint=usage)
    if isinstance(error, OSError):
        where = f": {error.filename}" if error.filename else ""
        return StorageError(
            f"{error.strerror or error}{where}", hint="check the path, its permissions and the disk"
        )
    first_line = next(iter(str(error).splitlines()), "")
    return HjepaError(
        f"unexpected {type(error).__name__}: {first_line}",
        hint="run it again with --debug (or HJEPA_DEBUG=1) to see the traceback, and report it",
    )
