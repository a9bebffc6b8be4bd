"""Users can cause or meet these errors, each with the exit code that the shell sees.

An :class:`HjepaError` is printed as one line (what was wrong, where, the valid choices) plus an
optional hint (the command to run next); it never shows a traceback. Codes follow sysexits.h.
"""

from importlib.util import find_spec


class HjepaError(Exception):
    """An expected error has a hint that says what to run or change next."""

    exit_code = 1

    def __init__(self, message: str, *, hint: str | None = None) -> None:
        super().__init__(message)
        self.message, self.hint = message, hint


class UsageError(HjepaError):
    """A flag, a setting or a combination of them is wrong."""

    exit_code = 2


class DataError(HjepaError):
    """A file does not hold what it should (foreign, truncated, tampered, other plant)."""

    exit_code = 65


class MissingInputError(HjepaError):
    """A dataset, checkpoint or model is not there."""

    exit_code = 66


def require(module: str, what: str, extra: str, instead: str = "") -> None:
    """Raise MissingInputError for what needs a package of an extra that is not installed."""
    if find_spec(module) is None:
        raise MissingInputError(
            f"{what}, which is not installed", hint=f'pip install "hjepa[{extra}]"{instead}'
        )


class Unavailable(HjepaError):
    """A network peer does not answer, or an address or a port cannot be had."""

    exit_code = 69


class NumericalError(HjepaError):
    """Training diverged, or a stage gate failed."""

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


class Interrupted(HjepaError):
    """Ctrl-C or SIGTERM has come: nothing is lost; the code is 128 + the signal's number."""

    def __init__(self, message: str, *, hint: str | None = None, code: int = 130) -> None:
        super().__init__(message, hint=hint)
        self.exit_code = code
