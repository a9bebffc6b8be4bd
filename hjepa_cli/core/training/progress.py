"""Training survives: its state goes to disk as it runs, and the same command takes it up.

``progress.safetensors`` in the run directory holds weights, moving averages, the optimiser's
moments, random streams and the rows of ``metrics.csv``, all of the same step. A run that is
interrupted at any step and continued therefore ends in the same bytes as one that is not.
"""

import os
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, Protocol, Self

import msgspec
import numpy as np
import torch
from torch import Tensor

from hjepa_cli.compute.interrupts import Postponed
from hjepa_cli.core.training.ranks import ALONE, Ranks
from hjepa_cli.errors import DataError, shell
from hjepa_cli.storage.checkpoints import load_checkpoint, save_checkpoint
from hjepa_cli.storage.files import jsonable
from hjepa_cli.storage.runs import Run, differences

PROGRESS_FILE = "progress.safetensors"
SAVE_EVERY_S = 60.0
TORCH_STREAM = "torch-stream"  # the state of torch's own generator, among the tensors
CUDA_STREAM = "cuda-stream"  # that of the GPU, in runs that compute on one
METRICS_ROWS = "metrics-rows"  # the text of metrics.csv, likewise: it may outgrow a header
MOST_THREADS = 4096

# What restoring a state raises that does not fit.
_MISFIT = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)


class Part(Protocol):
    """Training changes such parts: a module, an optimiser."""

    def state_dict(self) -> Mapping[str, Tensor]: ...

    def load_state_dict(self, state: dict[str, Tensor], /) -> Any: ...


class Saved(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """``progress.safetensors`` says that ``step`` steps of ``phase`` are done, in ``seconds``."""

    phase: str
    step: Annotated[int, msgspec.Meta(ge=0)]
    finished: list[str]  # loops before this one
    stream: dict[str, Any]  # of the loop's numpy generator
    threads: Annotated[int, msgspec.Meta(gt=0, le=MOST_THREADS)]  # others sum in another order
    seconds: float
    metrics: str | None = None  # of metrics.csv, in files from before it was among the tensors
    settings: dict[str, Any] | None = None  # of the run; older files do not say


class Progress:
    """It keeps the state of a training run, and as a context manager postpones Ctrl-C inside loops.

    All ``ranks`` read it, the first one writes it, and puts the run's metrics back to where it was
    taken; ``say`` tells that a run is taken up. Raises DataError if it is damaged.
    """

    def __init__(self, record: Run, say: Callable[[str], None], ranks: Ranks = ALONE) -> None:
        self._record, self._ranks, self._opened_s = record, ranks, time.monotonic()
        self._path = record.path(PROGRESS_FILE)
        self._interrupts = Postponed()
        self._saved: Saved | None = None
        self._tensors: dict[str, Tensor] = {}
        self._finished: list[str] = []
        if record.result is not None:
            self.remove()  # a kill between the result and this left it behind
        elif record.resumed:
            self._read(say)

    @property
    def fresh(self) -> bool:
        """Tell whether nothing is saved yet."""
        return self._saved is None

    @property
    def seconds(self) -> float:
        """Return the time spent on this run up to now, over all its interruptions."""
        before = self._saved.seconds if self._saved else 0.0
        return before + time.monotonic() - self._opened_s

    @property
    def state(self) -> str:
        """Return where the run stands, in words that are the same for all processes."""
        return f"{self._saved.phase} after step {self._saved.step}" if self._saved else "its start"

    def reached(self, phase: str) -> int:
        """Return the steps of ``phase`` that were done before."""
        return self._saved.step if self._saved and self._saved.phase == phase else 0

    def steps(
        self, phase: str, total: int, parts: Mapping[str, Part], stream: np.random.Generator
    ) -> Iterator[int]:
        """Yield the steps of a loop that are left of ``total``, and keep its state as it goes.

        A step counts when its body has ended; only then is anything saved, every
        :data:`SAVE_EVERY_S`, after the last step, and when Ctrl-C or SIGTERM came in between.

        Args:
            phase: the loop's name, unique in the run.
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

    def __exit__(self, *raised: object) -> None:
        self._interrupts.__exit__(*raised)

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
        if torch.cuda.is_initialized():  # type: ignore[no-untyped-call]  # dropout draws there
            tensors[CUDA_STREAM] = torch.cuda.get_rng_state().numpy()
        tensors[METRICS_ROWS] = np.array(bytearray(self._record.metrics.encode()), np.uint8)
        state, seconds = jsonable(stream.bit_generator.state), round(self.seconds, 2)
        threads, settings = torch.get_num_threads(), self._record.settings
        saved = Saved(phase, step, self._finished, state, threads, seconds, settings=settings)
        save_checkpoint(self._path, tensors, msgspec.to_builtins(saved))

    def _read(self, say: Callable[[str], None]) -> None:
        """Take up the saved state; without one the run begins again, from the same seed."""
        rows = ""
        if not os.path.lexists(self._path):
            say(f"{self._record.directory} was interrupted before its first save")
        else:
            checkpoint = load_checkpoint(self._path)
            self._tensors = {
                name: torch.from_numpy(array.copy()) for name, array in checkpoint.tensors.items()
            }
            try:
                self._saved = saved = msgspec.convert(checkpoint.metadata, Saved)
                rows = saved.metrics or ""
                if saved.metrics is None:
                    rows = self._tensors.pop(METRICS_ROWS).numpy().tobytes().decode()
            except (msgspec.ValidationError, KeyError, ValueError) as error:
                raise self._misfit(error) from None
            settings = self._record.settings  # none where another process leads
            if saved.settings and settings:
                before = saved.settings | {"preset": self._record.preset}
                if changed := differences(before, settings):
                    raise self._misfit(f"it was saved under other settings: {'; '.join(changed)}")
            self._finished = list(saved.finished)
            if saved.threads != torch.get_num_threads():
                torch.set_num_threads(saved.threads)
            say(f"{self._record.directory}: {saved.phase} goes on after step {saved.step}")
        if self._ranks.leads:
            self._record.metrics = rows

    def _restore(self, parts: Mapping[str, Part], stream: np.random.Generator) -> None:
        assert self._saved is not None
        try:
            torch.set_rng_state(self._tensors.pop(TORCH_STREAM))
            on_gpu = self._tensors.pop(CUDA_STREAM, None)  # not there in files of older versions
            if on_gpu is not None and torch.cuda.is_available():
                torch.cuda.set_rng_state(on_gpu)
            stream.bit_generator.state = self._saved.stream
            for part, state in parts.items():
                prefix = f"{part}."
                own = [name for name in self._tensors if name.startswith(prefix)]
                tensors = {name[len(prefix) :]: self._tensors.pop(name) for name in own}
                state.load_state_dict(tensors)
        except _MISFIT as error:
            raise self._misfit(error) from None
        if self._tensors:
            raise self._misfit(f"unexpected {min(self._tensors)}")

    def _misfit(self, reason: object) -> DataError:
        line = str(reason).partition("\n")[0]
        return DataError(
            f"{self._path} does not fit this run: {line}",
            hint=f"delete it to train from the start: {shell(['rm', self._path])}",
        )
