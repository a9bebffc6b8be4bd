"""Every error a user can cause or meet, with the exit code the shell sees.

An :class:`HjepaError` is printed as one line (what was wrong, where, the valid choices) plus an
optional hint (the command to run next); it never shows a traceback. Codes follow sysexits.h.
"""


class HjepaError(Exception):
    """Base of all expected errors.

    Args:
        message: one line: what was wrong, where, and the valid choices.
        hint: what to run or change next.
    """

    exit_code = 1

    def __init__(self, message: str, *, hint: str | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint


class UsageError(HjepaError):
    """A flag, a setting or a combination of them is wrong."""

    exit_code = 2


class DataError(HjepaError):
    """A file does not hold what it should (foreign, truncated, tampered, other plant)."""

    exit_code = 65


class MissingInputError(HjepaError):
    """A dataset, checkpoint or model is not there."""

    exit_code = 66


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


class Interrupted(HjepaError):
    """Ctrl-C or SIGTERM; nothing is lost.

    Args:
        message, hint: as for :class:`HjepaError`.
        code: 128 + the signal's number.
    """

    exit_code = 130

    def __init__(self, message: str, *, hint: str | None = None, code: int = 130) -> None:
        super().__init__(message, hint=hint)
        self.exit_code = code
