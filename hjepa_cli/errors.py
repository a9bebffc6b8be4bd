"""Users can cause or meet these errors, each with the exit code that the shell sees.

An :class:`HjepaError` is printed as one line (what was wrong, where, the valid choices) plus an
optional hint (the command to run next); it never shows a traceback. Codes follow sysexits.h. Below
them is what messages are made of.
"""

import difflib
import os
import shlex
from collections.abc import Callable, Iterable, Sequence
from importlib.util import find_spec

MOST_NAMED = 20  # files in one message


class HjepaError(Exception):
    """An expected error has a hint that says what to run or change next."""

    exit_code = 1

    def __init__(self, message: str, *, hint: str | None = None) -> None:
        super().__init__(message)
        self.message, self.hint = message, hint


class UsageError(HjepaError):
    """A flag, a setting, a plugin or a combination of them is wrong.

    ``key`` is that of the setting, where it is one that may come from a file.
    """

    exit_code = 2

    def __init__(self, message: str, *, hint: str | None = None, key: str | None = None) -> None:
        super().__init__(message, hint=hint)
        self.key = key

    def locate(self, place: Callable[[str], str]) -> None:
        """Write, once, where the setting was set: after what is wrong, before the choices."""
        if self.key is not None:
            head, sign, choices = self.message.partition("; ")
            self.message = f"{head}{place(self.key)}{sign}{choices}"
            self.args, self.key = (self.message,), None


class ArrayError(UsageError, ValueError):
    """An array from outside has another shape, type or range than a function takes."""


class DataError(HjepaError):
    """A file does not hold what it should (foreign, truncated, tampered, other plant)."""

    exit_code = 65


class MissingInputError(HjepaError):
    """A dataset, checkpoint or model is not there."""

    exit_code = 66


class Unavailable(HjepaError):
    """A network peer does not answer, or an address or a port cannot be had."""

    exit_code = 69


class NumericalError(HjepaError):
    """Training diverged, or a stage gate failed."""

    exit_code = 70


class OutOfMemory(HjepaError):
    """The work that was asked for does not fit into memory."""

    exit_code = 70


class StorageError(HjepaError):
    """The disk refused: not writable, full, I/O error."""

    exit_code = 74


class ClusterLost(HjepaError):
    """The scheduler of a cluster has gone in the middle of the work."""

    exit_code = 74


class LockedError(HjepaError):
    """Another process works in the same run directory."""

    exit_code = 75


class Unsealed(UserWarning):
    """A file of an older version has no seal: nobody can tell whether it was changed."""


class Unlocked(UserWarning):
    """A file system has no locks: nobody can tell whether another process works in a directory."""


class Interrupted(HjepaError):
    """Ctrl-C or SIGTERM has come: nothing is lost; the code is 128 + the signal's number."""

    def __init__(self, message: str, *, hint: str | None = None, code: int = 130) -> None:
        super().__init__(message, hint=hint)
        self.exit_code = code


def shell(words: Iterable[object]) -> str:
    """Return a command as a shell takes it back, in one line and whatever bytes are in a path."""
    return " ".join(map(_quoted, map(str, words)))


def _quoted(word: str) -> str:
    if word.isprintable():
        return shlex.quote(word)
    plain = (
        chr(b) if 32 <= b < 127 and b not in b"'\\" else f"\\x{b:02x}" for b in os.fsencode(word)
    )
    return f"$'{''.join(plain)}'"


def meant(name: object, names: Iterable[str], prefix: str = "") -> str:
    """Ask whether the nearest of some names was meant, for a message; ``""`` where none is near.

    All of them are said with the ``prefix``.
    """
    near = difflib.get_close_matches(str(name), names, n=1)
    return f"did you mean '{prefix}{near[0]}'? " if near else ""


def choices(name: object, names: Iterable[str], verb: str = "choose from") -> str:
    """Say what a name may be, for a message: the nearest first, then all."""
    return f"{meant(name, names := list(names))}{verb} {', '.join(names)}"


def require(module: str, what: str, extra: str, instead: str = "") -> None:
    """Raise MissingInputError for what needs a package of an extra that is not installed."""
    if find_spec(module) is None:
        raise MissingInputError(
            f"{what}, which is not installed", hint=f'pip install "hjepa[{extra}]"{instead}'
        )


def together(errors: Sequence[HjepaError]) -> HjepaError:
    """Return the first of some errors about files; where there are more, it names them all."""
    first = errors[0]
    if len(errors) > 1:
        named = [one.message for one in errors[:MOST_NAMED]]
        named += [f"{len(errors) - MOST_NAMED} more"] * (len(errors) > MOST_NAMED)
        first.message = f"{len(errors)} files are damaged or unreadable: {'; '.join(named)}"
    return first
