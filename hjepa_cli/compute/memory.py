"""Work that cannot fit into memory is refused at its start, not killed in its middle."""

import contextlib
import os
import re
import resource
from pathlib import Path

from hjepa_cli.errors import OutOfMemory

CGROUPS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
SAYS_SO = re.compile(  # of the errors of numpy and torch that are no MemoryError
    "can't allocate memory|not enough memory|out of memory|array is too big|Maximum allowed dim|"
    "maximum supported dimension|too large to convert to C|calculation overflowed|"
    "multiplication overflow|cannot allocate memory|Cannot allocate memory"
)
SMALLER = "choose smaller sizes; --dry-run tells what a command would take"


def limit_bytes() -> int:
    """Return how much memory this process may have: of the machine, its container and its shell."""
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    for path in CGROUPS:
        with contextlib.suppress(OSError, ValueError):  # "max" is no number
            limits.append(int(Path(path).read_text()))
    for kind in (resource.RLIMIT_AS, resource.RLIMIT_DATA):
        soft, _ = resource.getrlimit(kind)
        limits += [soft] if soft != resource.RLIM_INFINITY else []
    return min(limits)


def check(need_bytes: float, what: str) -> None:
    """Raise OutOfMemory where ``what`` takes more memory than there is."""
    if need_bytes > (limit := limit_bytes()):
        raise OutOfMemory(
            f"{what} takes about {need_bytes / 1e9:,.1f} GB of memory; "
            f"there are {limit / 1e9:,.1f} GB",
            hint=SMALLER,
        )


def ran_out(error: BaseException) -> bool:
    """Return whether an exception means that memory, or what can be counted in it, ran out."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    return isinstance(error, RuntimeError | ValueError | OverflowError) and bool(
        SAYS_SO.search(str(error))
    )
