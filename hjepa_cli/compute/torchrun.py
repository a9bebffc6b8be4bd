"""``torchrun`` tells the processes that it starts who they are; this imports nothing heavy.

Several processes train one encoder (:mod:`hjepa_cli.core.training.ranks`). The first leads: it
alone prints and writes files.
"""

import os

from hjepa_cli.errors import HjepaError, NumericalError, UsageError


class OneOfSeveral(HjepaError):
    """Only one process knows this error, so it prints it without leading."""


class ContactLost(NumericalError, OneOfSeveral):
    """Another process was killed or has failed."""


def size() -> int:
    """Return how many processes train together; 1 without torchrun."""
    return int(os.environ["WORLD_SIZE"]) if "TORCHELASTIC_RUN_ID" in os.environ else 1


def rank() -> int:
    """Return the number of this one, from 0."""
    return int(os.environ["RANK"]) if size() > 1 else 0


def follows() -> bool:
    """Return whether another process leads."""
    return rank() > 0


def program() -> str:
    """Return how this program was started, for hints."""
    if size() == 1:
        return "hjepa"
    here = int(os.environ["LOCAL_WORLD_SIZE"])
    machines = "" if here == size() else f"--nnodes {size() // here} ... "
    return f"torchrun {machines}--nproc-per-node {here} -m hjepa_cli"


def refuse() -> None:
    """Refuse what all processes would do, each for itself. Raises UsageError."""
    if size() > 1:
        raise UsageError(
            f"torchrun's {size()} processes would each do this command; it is for train-encoder",
            hint="run it without torchrun; collect, eval and scale have --workers and --cluster",
        )
