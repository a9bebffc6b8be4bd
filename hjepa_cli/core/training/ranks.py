"""One training runs on several processes, which ``torchrun`` starts.

Every process draws the same batch and takes its share of the windows. Gradients, losses and the
statistics of batch norm are summed over all processes, so a step is that of one process with the
whole batch, whatever their number; only the order of the sums differs.
"""

import asyncio
import dataclasses
import datetime
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch import distributed as dist

from hjepa_cli.compute import torchrun
from hjepa_cli.errors import HjepaError, UsageError

# The others wait that long: for the first process while it examines the encoder, most of all.
TIMEOUT = datetime.timedelta(minutes=30)
_untyped: Any = dist  # its stores have no types
QUIET_S, POLL_S = 3.0, 0.05  # processes that start together differ by a second or so


@dataclasses.dataclass(frozen=True)
class Ranks:
    """The processes of a training are seen from one of them, number ``rank`` of ``size``."""

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Say whether this process prints and writes."""
        return self.rank == 0

    def share(self, count: int) -> slice:
        """Return which of ``count`` items are this process's; shares differ by one at most."""
        return slice(count * self.rank // self.size, count * (self.rank + 1) // self.size)

    def add_up(self, tensors: Sequence[Tensor]) -> None:
        """Replace float tensors by their sums over all processes, in one message."""
        if self.size == 1:
            return
        flat = torch.cat([tensor.detach().flatten() for tensor in tensors])
        all_reduce(flat)
        parts = torch.split(flat, [tensor.numel() for tensor in tensors])
        with torch.no_grad():
            for tensor, part in zip(tensors, parts, strict=True):
                tensor.copy_(part.view(tensor.shape))

    def gather(self, value: int) -> list[int]:
        """Return the ``value`` of every process, by rank; all must ask."""
        if self.size == 1:
            return [value]
        values = torch.zeros(self.size, dtype=torch.int64)
        values[self.rank] = value
        all_reduce(values)
        found: list[int] = values.tolist()
        return found

    @contextmanager
    def together(self) -> Iterator[None]:
        """Let all processes pass this block, or none.

        Raises:
            HjepaError: this process's own error, or that another one has failed.
        """
        try:
            yield
        except HjepaError as error:
            codes = self.gather(error.exit_code)
            if self.leads or codes[0]:
                raise
            alone = torchrun.OneOfSeveral(
                f"process {self.rank} of {self.size}: {error.message}", hint=error.hint
            )
            alone.exit_code = error.exit_code
            raise alone from None
        codes = self.gather(0)
        if failed := [rank for rank, code in enumerate(codes) if code]:
            stopped = HjepaError(
                f"process {failed[0]} of {self.size} cannot take part",
                hint="its own message says why",
            )
            stopped.exit_code = codes[failed[0]]
            raise stopped


ALONE = Ranks()


@contextmanager
def joined(device: torch.device, items: int) -> Iterator[Ranks]:
    """Meet the other processes of this ``torchrun``, to share a batch of ``items`` windows.

    Without it a process is alone. On GPUs, each process of a machine takes its own.

    Raises:
        UsageError: more processes than windows, or than GPUs of this machine, or not all come.
    """
    size = torchrun.size()
    if size == 1:
        yield ALONE
        return
    if size > items:
        raise UsageError(
            f"{size} processes cannot share a batch of {items} windows",
            hint=f"torchrun with at most {items} processes, or a larger encoder.batch_trajectories",
        )
    if device.type == "cuda":
        here, there = int(os.environ["LOCAL_WORLD_SIZE"]), torch.cuda.device_count()
        if here > there:
            raise UsageError(
                f"{here} processes on a machine with {there} GPUs",
                hint=f"torchrun --nproc-per-node {there}, or --device cpu",
            )
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    # The optimiser's first step imports this, and what it imports keeps the process group that it
    # finds. The group's threads then outlive it, and some ends of the interpreter abort on them.
    from torch import _dynamo  # noqa: F401

    # Counts and codes are exchanged on the CPU, whatever the device.
    backend = "cpu:gloo,cuda:nccl" if device.type == "cuda" else "gloo"
    store, rank = _meet(torchrun.rank(), size), torchrun.rank()
    dist.init_process_group(backend, store=store, rank=rank, world_size=size, timeout=TIMEOUT)
    try:
        yield Ranks(rank, size)
    finally:
        dist.destroy_process_group()


def _meet(rank: int, size: int) -> Any:
    """Wait until all processes are there, say so where it takes long, and return what they share.

    torch would wait for half an hour without a word, deaf to Ctrl-C and SIGTERM.

    Raises:
        UsageError: the port is taken, or some have not come in :data:`TIMEOUT`.
    """
    host, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
    serves = rank == 0 and os.environ.get("TORCHELASTIC_USE_AGENT_STORE") != "True"
    attempt = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")
    store, said, began_s = None, False, time.monotonic()
    here = [f"{attempt}/{number}" for number in range(size)]
    while True:
        try:
            if store is None:
                if not serves:  # torch prints a page where nobody listens
                    asyncio.run(_reach(host, port))
                second = datetime.timedelta(seconds=1)
                store = _untyped.TCPStore(host, port, size, serves, second, wait_for_workers=False)
                store.set(here[rank], "")
            if store.check(here):
                store.set_timeout(TIMEOUT)
                return _untyped.PrefixStore(attempt, store)
        except (dist.DistError, OSError) as error:
            if serves:
                raise UsageError(
                    f"MASTER_PORT = {port}: cannot listen there: {str(error).partition('.')[0]}",
                    hint="set another MASTER_PORT for all processes",
                ) from None
            store = None  # whoever serves is not there yet, or has gone
        waited_s = time.monotonic() - began_s
        if waited_s > TIMEOUT.total_seconds():
            raise UsageError(f"{size} processes did not all come to {host}:{port}")
        if waited_s > QUIET_S and not said:
            said = True
            torchrun.announce(f"process {rank}: waiting for {size} processes at {host}:{port}")
        time.sleep(POLL_S)


async def _reach(host: str, port: int) -> None:
    """Raise OSError unless somebody listens there."""
    _, there = await asyncio.wait_for(asyncio.open_connection(host, port), timeout=1)
    there.close()


def all_reduce(tensor: Tensor) -> None:
    """Replace ``tensor`` by its sum over all processes.

    Raises:
        ContactLost: another process is gone.
    """
    try:
        dist.all_reduce(tensor)
    except RuntimeError:
        raise torchrun.ContactLost(
            f"process {torchrun.rank()} of {torchrun.size()} has lost the others: one was killed "
            "or has failed",
            hint="run the same command again; with --out it goes on where it was saved",
        ) from None


class Summed(torch.autograd.Function):
    """It sums a tensor over all processes, for losses that are summed over them too."""

    @staticmethod
    def forward(ctx: object, x: Tensor) -> Tensor:
        all_reduce(total := x.clone())
        return total

    @staticmethod
    def backward(ctx: object, *gradients: Tensor) -> Tensor:
        all_reduce(total := gradients[0].clone())
        return total


summed: Callable[[Tensor], Tensor] = Summed.apply
