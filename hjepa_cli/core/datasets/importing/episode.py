"""A recording has episodes: pictures, read one after the other, and actions between them."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.core.arrays import Floats
from hjepa_cli.errors import DataError

Pictures = Iterator[NDArray[Any]]
"""Blocks of pictures as the source has them: [n, H, W, C], [n, C, H, W] or [n, H, W]."""


@dataclasses.dataclass(frozen=True, eq=False)
class Episode:
    """An episode is read without its pictures.

    Attributes:
        name: for messages.
        pictures: how many there are.
        stream: reads them in order from the picture of a given row on.
        actions: row j leads from picture j to picture j + 1, [rows, A].
        states: those that the pictures show [pictures, S]; ``None`` if nobody recorded any.
        expert: what an expert would do at each picture [rows, A]; ``None`` where that is done.
        times_s: of the pictures [pictures]; ``None`` where nobody recorded any.
    """

    name: str
    pictures: int
    stream: Callable[[int], Pictures]
    actions: Floats
    states: Floats | None = None
    expert: Floats | None = None
    times_s: Floats | None = None


Entries: TypeAlias = Sequence[tuple[str, Callable[[], Episode]]]


@dataclasses.dataclass(frozen=True, eq=False)
class Recording:
    """A recording is what a reader found at a path.

    Attributes:
        format: as in ``--format``.
        episodes: name of each, and what reads it; that raises a DataError where it is unsound.
        step_s: between pictures; ``None`` where the source does not say.
        limits: of each action; ``None`` where the source does not say.
        state_names: of the states, if there are any.
        lossy: whether its pictures were compressed with losses.
        close: closes what its pictures are read from.
    """

    format: str
    episodes: Entries
    step_s: float | None = None
    limits: tuple[float, ...] | None = None
    state_names: tuple[str, ...] = ()
    lossy: bool = False
    close: Callable[[], object] = lambda: None


def table(values: Any, name: str, what: str) -> Floats:
    """Return rows of numbers as float64 [rows, columns]; a plain list of numbers is one column.

    Raises:
        DataError: they are no numbers, or their shape is another one.
    """
    try:
        if np.iscomplexobj(values):
            raise TypeError
        rows = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise DataError(f"{name}: {what} are no real numbers") from None
    if rows.ndim == 1:
        rows = rows[:, None]
    if rows.ndim != 2 or not rows.shape[1]:
        raise DataError(f"{name}: {what} have shape {rows.shape}; expected [rows, columns]")
    return rows
