"""Other people's dashboards get copies of a run's metrics, if asked for.

``HJEPA_LOG=tensorboard`` writes TensorBoard event files into the run directory as it trains.
Nothing leaves the machine, and no account is asked for. ``metrics.csv`` is written in any case.
"""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from hjepa_cli.errors import MissingInputError, UsageError

VARIABLE = "HJEPA_LOG"

Tracker = Callable[[Mapping[str, int | float | str | None]], None]
"""Takes one row of ``metrics.csv``."""


def requested() -> Callable[[Path], Tracker] | None:
    """Return what makes the tracker of a run directory, if ``HJEPA_LOG`` asks for one.

    Raises:
        UsageError: an unknown logger.
        MissingInputError: its package is not installed.
    """
    if not (wanted := os.environ.get(VARIABLE)):
        return None
    if wanted != "tensorboard":
        raise UsageError(
            f"{VARIABLE}={wanted}: unknown logger; the only one is tensorboard",
            hint=f"unset {VARIABLE}, or {VARIABLE}=tensorboard",
        )
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ModuleNotFoundError:
        raise MissingInputError(
            f"{VARIABLE}=tensorboard needs tensorboard, which is not installed",
            hint=f'pip install "hjepa[track]", or unset {VARIABLE}',
        ) from None

    def tensorboard(directory: Path) -> Tracker:
        writer: Any = None

        def track(row: Mapping[str, int | float | str | None]) -> None:
            nonlocal writer
            step = int(row.get("step") or 0)
            if writer is None:  # what an interrupted run has logged beyond this step is discarded
                writer = SummaryWriter(str(directory), purge_step=step)
            group = f"{row['level']}/" if row.get("level") else ""
            for name, value in row.items():
                if name != "step" and isinstance(value, int | float):
                    writer.add_scalar(group + name, value, step)
            writer.flush()

        return track

    return tensorboard
