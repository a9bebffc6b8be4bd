"""The standard streams may be closed, full or without a reader: work goes on, and its end tells.

A run must not die of a full log disk, nor an error of the stream that it would be told on. So what
a stream refuses is dropped, once and for all, and remembered. Only the reader of a pipe who goes
away ends what it was reading, as everywhere in a shell.
"""

import contextlib
import io
import os
import select
import sys
from collections.abc import Iterator
from typing import Any, TextIO

from hjepa_cli.errors import HjepaError, StorageError


class PipeClosed(HjepaError):
    """Whoever read our output has gone, as in ``hjepa scale | head -1``: we end without a word."""

    exit_code = StorageError.exit_code


class Lasting(io.FileIO):
    """It is a descriptor that takes all that is written; ``lost`` is why some of it went nowhere.

    The first time that a pipe has no reader is PipeClosed where ``ends``.
    """

    lost: OSError | None = None
    ends = False

    def write(self, data: Any) -> int:
        """Write bytes, waiting for a descriptor that does not; return how many are dealt with."""
        while self.lost is None:
            try:
                if (count := super().write(data)) is not None:
                    return count
                select.select([], [self], [])
            except OSError as error:
                self.lost = error
                if self.ends and isinstance(error, BrokenPipeError):
                    raise PipeClosed("output closed") from None
        return memoryview(data).nbytes


@contextlib.contextmanager
def lasting_streams() -> Iterator[Lasting | None]:
    """Let stdout and stderr take all that is written inside; yield what stdout is written to.

    Without a stream, or with one that is closed, that is the null device; what a program such as
    pytest has put in their place is left as it is, and ``None`` is yielded.
    """
    _occupy()
    before = sys.stdout, sys.stderr
    out, sys.stdout = _opened(sys.stdout, 1)
    _, sys.stderr = _opened(sys.stderr, 2)
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
            nowhere = os.open(os.devnull, os.O_RDWR)
            if nowhere == number:
                os.set_inheritable(number, True)  # processes that we start need one too
            else:
                os.dup2(nowhere, number)
                os.close(nowhere)


def _opened(old: TextIO | None, number: int) -> tuple[Lasting | None, TextIO]:
    """Return a stream in place of ``old``, and its descriptor where it is one of ours."""
    is_file = old is None or old.closed
    if old is not None and not is_file and type(old) is io.TextIOWrapper:
        with contextlib.suppress(OSError):  # a text that is no file
            number, is_file = old.fileno(), True
    if not is_file:
        if isinstance(old, io.TextIOWrapper):  # an ASCII-only terminal gets "?", not a crash
            old.reconfigure(errors="replace")
        assert old is not None
        return None, old
    with contextlib.suppress(OSError, ValueError, AttributeError):  # None, closed or full
        old.flush()  # type: ignore[union-attr]
    raw = Lasting(number, "w", closefd=False)
    text = io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=getattr(old, "encoding", None) or "utf-8",
        errors="replace",
        line_buffering=raw.isatty() or number == 2,
        write_through=getattr(old, "write_through", False),
    )
    return raw, text
