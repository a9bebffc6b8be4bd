"""Training that survives: its state goes to disk as it runs, and the same command takes it up.

``progress.safetensors`` in the run directory holds weights, moving averages, the optimiser's
moments, random streams and the rows of ``metrics.csv``, all of the same step. A run that is
interrupted at any step and continued therefore ends in the same bytes as one that is not.
"""

import dataclasses
import os
import time
from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np
import torch
from torch import Tensor

from hjepa_cli.compute.interrupts import Postponed
from hjepa_cli.core.training.ranks import ALONE, Ranks
from hjepa_cli.errors import DataError
from hjepa_cli.output.screen import Screen
from hjepa_cli.storage.checkpoints import load_checkpoint, save_checkpoint
from hjepa_cli.storage.runs import Run

PROGRESS_FILE = "progress.safetensors"
SAVE_EVERY_S = 60.0
TORCH_STREAM = "torch-stream"  # the state of torch's own generator, among the tensors
METRICS_ROWS = "metrics-rows"  # the text of metrics.csv, likewise: it may outgrow a header
MOST_THREADS = 4096

# What restoring a state raises that does not fit.
_MISFIT = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)


class Part(Protocol):
    """Anything that training changes: a module, an optimiser."""

    def state_dict(self) -> Mapping[str, Tensor]: ...

    def load_state_dict(self, state: dict[str, Tensor], /) -> Any: ...


@dataclasses.dataclass(frozen=True)
class Saved:
    """What ``progress.safetensors`` says besides tensors.

    Attributes:
        phase: the loop it was taken in.
        step: steps done in it.
        finished: loops before it, all done.
        stream: state of the loop's numpy generator.
        threads: threads that torch computes with; sums differ in the last bit with others.
        seconds: spent on the run so far.
    """

    phase: str
    step: int
    finished: list[str]
    stream: dict[str, Any]
    threads: int
    seconds: float


class Progress:
    """The saved state of a training run; a context manager that postpones Ctrl-C inside loops.

    Args:
        record: the run; its metrics are put back to where the saved state was taken.
        screen: where to say that a run is taken up.
        ranks: the processes that train; all read the saved state, the first one writes it.

    Raises:
        DataError: the saved state is damaged.
    """

    def __init__(self, record: Run, screen: Screen, ranks: Ranks = ALONE) -> None:
        self._record, self._ranks, self._opened_s = record, ranks, time.monotonic()
        self._path = record.path(PROGRESS_FILE)
        self._interrupts = Postponed()
        self._saved: Saved | None = None
        self._tensors: dict[str, Tensor] = {}
        self._finished: list[str] = []
        if record.result is not None:
            self.remove()  # a kill between the result and this left it behind
        elif record.resumed:
            self._read(screen)

    @property
    def fresh(self) -> bool:
        """Nothing is saved yet."""
        return self._saved is None

    @property
    def seconds(self) -> float:
        """Spent on this run up to now, over all its interruptions."""
        before = self._saved.seconds if self._saved else 0.0
        return before + time.monotonic() - self._opened_s

    @property
    def state(self) -> str:
        """Where the run stands, in words that are the same for all processes."""
        return f"{self._saved.phase} after step {self._saved.step}" if self._saved else "its start"

    def reached(self, phase: str) -> int:
        """Steps of ``phase`` that were done before."""
        return self._saved.step if self._saved and self._saved.phase == phase else 0

    def steps(
        self, phase: str, total: int, parts: Mapping[str, Part], stream: np.random.Generator
    ) -> Iterator[int]:
        """Yield the steps of a loop that are left, and keep its state as it goes.

        A step counts when its body has ended; only then is anything saved, every
        :data:`SAVE_EVERY_S`, after the last step, and when Ctrl-C or SIGTERM came in between.

        Args:
            phase: the loop's name, unique in the run.
            total: its steps.
            parts: all that the loop changes and all that later ones need, by name; put back here.
            stream: the loop's random numbers; put back here, as are torch's.

        Raises:
            Interrupted: the state is saved, the message says how to go on.
            DataError: the saved state does not fit.
            StorageError: the disk refused.
        """
        if self._saved and phase in self._saved.finished:
            return
        start = self.reached(phase)
        if start > total:
            raise self._misfit(f"step {start} of {total}")
        if self._tensors and self._saved:
            if self._saved.phase != phase:
                raise self._misfit(f"saved in '{self._saved.phase}', which is not '{phase}'")
            self._restore(parts, stream)
        saved_s = time.monotonic()
        with self._interrupts.postpone() as stopped:
            for step in range(start, total):
                yield step
                stop = any(self._ranks.gather(stopped()))  # all stop after the same step
                due = time.monotonic() - saved_s >= SAVE_EVERY_S
                if due or stop or step + 1 == total:
                    self._save(phase, step + 1, parts, stream)
                    saved_s = time.monotonic()
                if stop:
                    raise self._interrupts.interrupted(
                        f"interrupted after step {step + 1} of {total} ({phase}); all is saved",
                        self._record.continue_command,
                    )
        self._finished.append(phase)

    def remove(self) -> None:
        """Forget the state: the run is finished."""
        if self._ranks.leads:
            self._path.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        self._interrupts.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._interrupts.__exit__(kind, error, trace)

    def _save(
        self, phase: str, step: int, parts: Mapping[str, Part], stream: np.random.Generator
    ) -> None:
        if not self._ranks.leads:
            return
        tensors = {
            f"{part}.{name}": tensor.detach().cpu().contiguous().numpy()
            for part, state in parts.items()
            for name, tensor in state.state_dict().items()
        }
        tensors[TORCH_STREAM] = torch.get_rng_state().numpy()
        tensors[METRICS_ROWS] = np.array(bytearray(self._record.metrics.encode()), np.uint8)
        saved = Saved(
            phase=phase,
            step=step,
            finished=self._finished,
            stream=_plain(stream.bit_generator.state),
            threads=torch.get_num_threads(),
            seconds=round(self.seconds, 2),
        )
        save_checkpoint(self._path, tensors, dataclasses.asdict(saved))

    def _read(self, screen: Screen) -> None:
        """Take up the saved state; without one the run begins again, from the same seed."""
        if not os.path.lexists(self._path):
            self._restore_metrics("")
            screen.say(f"{self._record.directory} was interrupted before its first save")
            return
        checkpoint = load_checkpoint(self._path)
        metadata = dict(checkpoint.metadata)
        rows = metadata.pop("metrics", None)  # where they were at first
        self._tensors = {
            name: torch.from_numpy(array.copy()) for name, array in checkpoint.tensors.items()
        }
        try:
            saved = _saved(metadata)
            if rows is None:
                rows = self._tensors.pop(METRICS_ROWS).numpy().tobytes().decode()
            if not isinstance(rows, str):
                raise TypeError("malformed metrics")
        except (KeyError, TypeError, ValueError) as error:
            raise self._misfit(error) from None
        self._saved, self._finished = saved, list(saved.finished)
        self._restore_metrics(rows)
        if saved.threads != torch.get_num_threads():
            torch.set_num_threads(saved.threads)
        screen.say(f"{self._record.directory}: {saved.phase} goes on after step {saved.step}")

    def _restore_metrics(self, text: str) -> None:
        if self._ranks.leads:
            self._record.metrics = text

    def _restore(self, parts: Mapping[str, Part], stream: np.random.Generator) -> None:
        assert self._saved is not None
        try:
            torch.set_rng_state(self._tensors.pop(TORCH_STREAM))
            stream.bit_generator.state = _arrays(self._saved.stream)
            for part, state in parts.items():
                prefix = f"{part}."
                own = [name for name in self._tensors if name.startswith(prefix)]
                state.load_state_dict(
                    {name.removeprefix(prefix): self._tensors.pop(name) for name in own}
                )
        except _MISFIT as error:
            raise self._misfit(error) from None
        if self._tensors:
            raise self._misfit(f"unexpected {min(self._tensors)}")

    def _misfit(self, reason: object) -> DataError:
        line = str(reason).partition("\n")[0]
        return DataError(
            f"{self._path} does not fit this run: {line}",
            hint=f"delete it to train from the start: rm {self._path}",
        )


def _saved(metadata: dict[str, Any]) -> Saved:
    """What a file says, its types checked. Raises TypeError."""
    saved = Saved(**metadata)
    good = (
        isinstance(saved.phase, str)
        and type(saved.step) is int
        and saved.step >= 0
        and isinstance(saved.finished, list)
        and all(isinstance(phase, str) for phase in saved.finished)
        and isinstance(saved.stream, dict)
        and type(saved.threads) is int
        and 0 < saved.threads <= MOST_THREADS
        and type(saved.seconds) in (int, float)
    )
    if not good:
        raise TypeError("malformed fields")
    return saved


def _plain(state: Mapping[str, Any]) -> dict[str, Any]:
    """The state of a numpy bit generator as JSON data."""
    return {
        key: _plain(value)
        if isinstance(value, Mapping)
        else [int(entry) for entry in value]
        if isinstance(value, np.ndarray)
        else value
        for key, value in state.items()
    }


def _arrays(state: Mapping[str, Any]) -> dict[str, Any]:
    """The inverse of :func:`_plain`."""
    return {
        key: _arrays(value)
        if isinstance(value, Mapping)
        else np.array(value, np.uint64)
        if isinstance(value, list)
        else value
        for key, value in state.items()
    }
