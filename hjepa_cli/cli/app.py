"""The program starts here: errors become one line and an exit code, whatever the command.

Nothing heavy is imported here: a command imports its stage when it runs, so that ``--help`` answers
at once.
"""

import contextlib
import os
import re
import sys
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn, TextIO

from typer.main import get_command

from hjepa_cli.cli.builder import build
from hjepa_cli.compute import memory, torchrun
from hjepa_cli.compute.interrupts import end_at_once, exit_code
from hjepa_cli.errors import (
    DataError,
    HjepaError,
    Interrupted,
    OutOfMemory,
    StorageError,
    UsageError,
    shell,
)
from hjepa_cli.output.screen import Screen, one_line
from hjepa_cli.output.streams import Lasting, PipeClosed, lasting_streams
from hjepa_cli.plugins import STAGES, blamed, in_force, load_file


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the program and exit: the only place where an error becomes a line and a code.

    The arguments are those of the process, without the program's name, unless others are given.
    """
    argv = list(sys.argv[1:] if arguments is None else arguments)
    with contextlib.ExitStack() as streams:
        out, errors = streams.enter_context(lasting_streams()), sys.stderr
        code = _run_command(argv, errors, streams, ends=arguments is None)
        code = _delivered(out, code)
    sys.exit(code)


def _delivered(out: Lasting | None, code: int) -> int:
    """Return an exit code, that of a disk that refused where results did not get out."""
    with contextlib.suppress(PipeClosed):
        sys.stdout.flush()
    if out is None or out.lost is None or code != 0:
        return code
    if not isinstance(out.lost, BrokenPipeError):
        reason = f"cannot write results to stdout: {out.lost.strerror}"
        Screen().error(reason, "free some disk space or write elsewhere; files of it are complete")
    return StorageError.exit_code


def _run_command(
    argv: list[str], errors: TextIO, streams: contextlib.ExitStack, *, ends: bool
) -> int:
    """Run one command; return the exit code after reporting any error to ``errors``.

    Where the process ``ends`` with it, a second Ctrl-C ends it at once.
    """
    follows = False
    try:
        if follows := torchrun.follows():  # the process that leads says the same
            nowhere = streams.enter_context(open(os.devnull, "w"))
            for redirect in (contextlib.redirect_stdout, contextlib.redirect_stderr):
                streams.enter_context(redirect(nowhere))
        for path in _given(argv, "--plugin"):  # one may add a command
            load_file(Path(path))
        returned = get_command(build(argv)).main(argv, prog_name="hjepa", standalone_mode=False)
        return returned if isinstance(returned, int) else 0
    except (Exception, KeyboardInterrupt, SystemExit) as error:  # the last resort
        if ends:
            end_at_once()
        if isinstance(error, SystemExit) and not blamed(error):
            raise  # of the shell's completion
        if "--debug" in argv or os.environ.get("HJEPA_DEBUG", "0") not in ("", "0"):
            traceback.print_exc()
        failure = _expected(error, argv)
        failure.hint = _with_plugins(failure.hint, argv)
    if isinstance(failure, PipeClosed):
        return failure.exit_code
    if follows and not isinstance(failure, torchrun.OneOfSeveral):
        return failure.exit_code
    screen = Screen(json="--json" in argv, stderr=errors)
    screen.error(failure.message, failure.hint)
    if screen.json:
        message, hint = one_line(failure.message), failure.hint
        with contextlib.suppress(PipeClosed):
            screen.emit({"error": {"code": failure.exit_code, "message": message, "hint": hint}})
    return failure.exit_code


def _given(argv: Sequence[str], name: str) -> Iterator[str]:
    """Yield the paths that a flag names anywhere on a command line."""
    words = iter(argv)
    for word in words:
        flag, sign, path = word.partition("=")
        if flag == name and (path := path if sign else next(words, "")):
            yield path


def _with_plugins(hint: str | None, argv: Sequence[str]) -> str | None:
    """Return a hint whose stages are given the plugins and settings files of this command.

    Without them its plant is unknown to them, or they take another one.
    """
    flags = ("--plugin", "--config")
    own = shell([word for flag in flags for path in _given(argv, flag) for word in (flag, path)])
    if hint is None or "--plugin" in hint or "--plugin" not in own:
        return hint
    stages = "|".join(map(re.escape, STAGES))
    return re.sub(rf"\bhjepa ({stages})(?![\w-])", lambda of: f"{of[0]} {own}", hint)


def _usage(argv: list[str]) -> str:
    """Return what shows the help of the command that was named, or the commands to choose from."""
    words: list[str] = []
    group: Any = None
    with contextlib.suppress(Exception):  # building it may be what has failed
        group = get_command(build())
    for word in argv:
        if word in (inside := getattr(group, "commands", {})):
            words.append(word)
            group = inside[word]
    if not words:
        return f"commands: {', '.join(getattr(group, 'commands', {}))}"
    for source in in_force():  # one may have made the command
        words += [] if source.installed else ["--plugin", source.name]
    return f"hjepa {shell(words)} --help"


def _expected(error: BaseException, argv: list[str]) -> HjepaError:
    """Return an exception as one of ours: a message, a hint and an exit code."""
    if isinstance(error, HjepaError):
        if error.hint is None:
            again = "restore the file or make it again; what this command reads: "
            error.hint = again * isinstance(error, DataError) + _usage(argv)
        return error
    if isinstance(error, KeyboardInterrupt):
        return Interrupted("interrupted", hint="run the same command again", code=exit_code(error))
    if hasattr(error, "format_message"):  # Typer's usage errors; it has no public base class
        return UsageError(" ".join(error.format_message().split()), hint=_usage(argv))
    if isinstance(error, UnicodeEncodeError):
        return UsageError(
            f"'{error.object}' has characters that this locale has no bytes for",
            hint="run it again with LC_ALL=C.UTF-8",
        )
    plugin = f"plugin {place}: " if (place := blamed(error)) else ""
    if isinstance(error, OSError):
        where = f": {error.filename}" if error.filename else ""
        return StorageError(
            f"{plugin}{error.strerror or error}{where}",
            hint="check the path, its permissions and the disk",
        )
    if memory.ran_out(error):
        return OutOfMemory(f"{plugin}not enough memory: {error}".rstrip(": "), hint=memory.SMALLER)
    first_line = next(iter(str(error).splitlines()), "")
    if plugin:
        return UsageError(
            f"{plugin}{type(error).__name__}: {first_line}",
            hint="correct it, or run it again with --debug to see the traceback",
        )
    return HjepaError(
        f"unexpected {type(error).__name__}: {first_line}",
        hint="run it again with --debug (or HJEPA_DEBUG=1) to see the traceback, and report it",
    )
