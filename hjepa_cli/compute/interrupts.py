"""Ctrl-C, SIGTERM and SIGHUP stop work at the next safe point; then a message says how to go on.

Without anybody in the way they raise: :class:`KeyboardInterrupt` and its kind :class:`Terminated`.
A loop that must not be cut postpones the first one and asks for it between its steps; a second one
stops at once.
"""

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Self

from hjepa_cli.errors import Interrupted

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Terminated(KeyboardInterrupt):
    """SIGTERM has come, as a batch system sends it before it kills; or SIGHUP, of a terminal's end.

    ``number`` is the signal's.
    """

    number = signal.SIGTERM


class HungUp(Terminated):
    """The terminal has gone, and whoever sat there: nobody has said nohup."""

    number = signal.SIGHUP


@contextmanager
def sigterm_raises() -> Iterator[None]:
    """Let SIGTERM and SIGHUP unwind the program like Ctrl-C; else it would end without a word.

    What is ignored from outside, as SIGHUP is under nohup, stays ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # handlers can be set in the main thread alone
        return
    with contextlib.ExitStack() as handlers:
        for number in (signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) != signal.SIG_IGN:
                handlers.callback(signal.signal, number, signal.signal(number, _raise))
        yield


def end_at_once() -> None:
    """Let a further signal end the process without a traceback: all that could be saved is."""
    if threading.current_thread() is threading.main_thread():
        for number in SIGNALS:
            if signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, lambda number, _: os._exit(128 + number))


def exit_code(error: BaseException) -> int:
    """Return what the shell sees of an interruption: 128 + the signal's number."""
    return 128 + (error.number if isinstance(error, Terminated) else signal.SIGINT)


class Postponed:
    """It handles all three signals while it is entered; see :meth:`postpone`."""

    def __init__(self) -> None:
        self._inside = False
        self._signal: int | None = None
        self._before: dict[int, Any] = {}

    @contextmanager
    def postpone(self) -> Iterator[Callable[[], bool]]:
        """Keep the first signal back; what is yielded tells whether it came."""
        self._inside = True
        try:
            yield lambda: self._signal is not None
        finally:
            self._inside = False
        if self._signal is not None:  # it came after the last look
            _raise(self._signal, None)

    def interrupted(self, message: str, hint: str) -> Interrupted:
        """Return the error to raise for the signal that was kept back."""
        # Without one, another process of the training was stopped: torchrun sends SIGTERM.
        return Interrupted(message, hint=hint, code=128 + (self._signal or signal.SIGTERM))

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():  # only there it is allowed
            self._before = {
                number: signal.signal(number, self._handle)
                for number in SIGNALS
                if signal.getsignal(number) != signal.SIG_IGN
            }
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._inside and self._signal is None:
            self._signal = number
        else:
            _raise(number, frame)


def _raise(number: int, frame: FrameType | None) -> None:
    if number == signal.SIGHUP:
        raise HungUp
    raise Terminated if number == signal.SIGTERM else KeyboardInterrupt
