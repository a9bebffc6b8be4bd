"""The standard streams may be closed, full or without a reader: work goes on, and its end tells.

A run must not die of a full log disk, nor an error of the stream that it would be told on. So what
a stream refuses is dropped, once and for all, and remembered. Only the reader of a pipe who goes
away ends what it was reading, as everywhere in a shell.
"""

import contextlib
import io
import os
import sys
from collections.abc import Iterator
from typing import TextIO

from hjepa_cli.errors import HjepaError, StorageError


class PipeClosed(HjepaError):
    """Whoever read our output has gone, as in ``hjepa scale | head -1``: we end without a word."""

    exit_code = StorageError.exit_code


class Lasting(io.TextIOWrapper):
    """It is a stream that takes all that is written; ``lost`` is why some of it went nowhere.

    The first time that a pipe has no reader is PipeClosed where ``ends``.
    """

    lost: OSError | None = None
    ends = False

    def write(self, text: str) -> int:
        """Write a text as a stream does."""
        with self._going_on():
            return super().write(text)
        return len(text)

    def flush(self) -> None:
        """Flush as a stream does."""
        with self._going_on():
            super().flush()

    @contextlib.contextmanager
    def _going_on(self) -> Iterator[None]:
        """Let what was refused, and all that follows, go to the null device."""
        try:
            yield
        except OSError as error:
            self.lost = error
            _put_nowhere(self.fileno())
            super().flush()  # what the refusal has left behind
            if self.ends and isinstance(error, BrokenPipeError):
                raise PipeClosed("output closed") from None


@contextlib.contextmanager
def lasting_streams() -> Iterator[Lasting | None]:
    """Let stdout and stderr take all that is written inside; yield what stdout is written to.

    Without a stream, or with one that is closed, that is the null device; what a program such as
    pytest has put in their place is left as it is, and ``None`` is yielded.
    """
    _occupy()
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = _opened(sys.stdout, 1), _opened(sys.stderr, 2)
    out = sys.stdout if isinstance(sys.stdout, Lasting) else None
    if out is not None:
        out.ends = True
    try:
        yield out
    finally:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError, PipeClosed):
                stream.flush()
        sys.stdout, sys.stderr = before


def _occupy() -> None:
    """Put the null device where 0, 1 or 2 is free: a file of ours there would be written into."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            _put_nowhere(number)


def _put_nowhere(number: int) -> None:
    """Make a descriptor one of the null device, which processes that we start have too."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    if nowhere == number:
        os.set_inheritable(number, True)
    else:
        os.dup2(nowhere, number)
        os.close(nowhere)


def _opened(old: TextIO | None, number: int) -> TextIO:
    """Return a stream of ours in place of ``old``, where that is a file or nothing."""
    is_file = old is None or old.closed
    if old is not None and not is_file and type(old) is io.TextIOWrapper:
        with contextlib.suppress(OSError):  # a text that is no file
            number, is_file = old.fileno(), True
    if not is_file:
        if isinstance(old, io.TextIOWrapper):  # an ASCII-only terminal gets "?", not a crash
            old.reconfigure(errors="replace")
        assert old is not None
        return old
    with contextlib.suppress(OSError, ValueError, AttributeError):  # None, closed or full
        old.flush()  # type: ignore[union-attr]
    with contextlib.suppress(OSError):  # else a slow reader would be an error
        os.set_blocking(number, True)
    return Lasting(
        io.BufferedWriter(io.FileIO(number, "w", closefd=False)),
        encoding=getattr(old, "encoding", None) or "utf-8",
        errors="replace",
        line_buffering=os.isatty(number) or number == 2,
        write_through=getattr(old, "write_through", False),
    )
