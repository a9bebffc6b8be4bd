"""``torchrun`` tells the processes that it starts who they are; this imports nothing heavy.

Several processes train one encoder (:mod:`hjepa_cli.core.training.ranks`). The first leads: it
alone prints and writes files.
"""

import contextlib
import os

from hjepa_cli.errors import HjepaError, NumericalError, UsageError


class OneOfSeveral(HjepaError):
    """Only one process knows this error, so it prints it without leading."""


class ContactLost(NumericalError, OneOfSeveral):
    """Another process was killed or has failed."""


def size() -> int:
    """Return how many processes train together; 1 without torchrun.

    Raises:
        UsageError: torchrun seems to have started this, and a variable that it sets is not there or
            is not what it sets.
    """
    if "TORCHELASTIC_RUN_ID" not in os.environ:
        return 1
    count, here = _number("WORLD_SIZE", 1), _number("LOCAL_WORLD_SIZE", 1)
    _number("RANK", 0, count - 1)
    _number("LOCAL_RANK", 0, here - 1)
    _number("MASTER_PORT", 1, 65535)
    if not os.environ.get("MASTER_ADDR"):
        raise _unlike("MASTER_ADDR", "expected the address of the first machine")
    return count


def rank() -> int:
    """Return the number of this one, from 0; errors as of :func:`size`."""
    return int(os.environ["RANK"]) if size() > 1 else 0


def announce(text: str) -> None:
    """Tell people what even a process that does not lead cannot keep to itself."""
    with contextlib.suppress(OSError):
        os.write(2, f"{text}\n".encode())


def _number(name: str, least: int, most: int | None = None) -> int:
    """Return the whole number in an environment variable; raise UsageError for anything else."""
    text = os.environ.get(name, "")
    number = int(text) if text.isascii() and text.isdigit() and len(text) < 10 else -1
    if number < least or (most is not None and number > most):
        span = f"at least {least}" if most is None else f"from {least} to {most}"
        raise _unlike(name, f"expected a whole number, {span}")
    return number


def _unlike(name: str, wanted: str) -> UsageError:
    found = os.environ.get(name)
    said = "is not set" if found is None else f"= {found!r}"
    return UsageError(
        f"environment variable {name} {said}, but TORCHELASTIC_RUN_ID is set as torchrun does; "
        f"{wanted}",
        hint="start it with torchrun --nproc-per-node N -m hjepa_cli ..., or: "
        "env -u TORCHELASTIC_RUN_ID hjepa ...",
    )


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
