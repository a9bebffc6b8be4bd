"""Recordings may be arrays: one for each episode, or parts of a long one."""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import accumulate, pairwise
from typing import Any, Protocol

from numpy.typing import NDArray

from hjepa_cli.core.datasets.importing.episode import Episode, Pictures, Recording, table
from hjepa_cli.errors import DataError

BLOCK = 64  # pictures read at a time


class Rows(Protocol):
    """An array whose rows can be read, not all at once: numpy's, HDF5's, an NPZ's."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Return the shape, rows first."""

    def __getitem__(self, rows: slice) -> NDArray[Any]: ...


class Part:
    """These rows ``first`` … ``stop`` − 1 of others are rows too."""

    def __init__(self, rows: Rows, first: int, stop: int) -> None:
        self._rows, self._first = rows, first
        self.shape = (stop - first, *rows.shape[1:])

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        start, stop, _ = rows.indices(self.shape[0])
        return self._rows[self._first + start : self._first + stop]


def parts(rows: Rows, lengths: Sequence[int], what: str) -> list[Part]:
    """Cut rows into parts of some lengths.

    Raises:
        DataError: there are more or fewer rows; it says ``what`` they are.
    """
    if not rows.shape or rows.shape[0] != sum(lengths) or min(lengths, default=0) < 0:
        raise DataError(
            f"{what} have shape {tuple(rows.shape)}; the episodes have {sum(lengths)} rows in all"
        )
    return [Part(rows, *ends) for ends in pairwise(accumulate(lengths, initial=0))]


def recording(
    pictures: Sequence[Rows], columns: Mapping[str, Sequence[Rows]], **about: Any
) -> Recording:
    """Return a recording of episodes.

    Args:
        pictures: of each episode, [rows, …].
        columns: ``actions``, and perhaps ``states`` and ``expert``, of each episode.
        about: the other fields of :class:`~.episode.Recording`.

    Raises:
        DataError: there are not as many of one as of the other.
    """
    for name, values in columns.items():
        if len(values) != len(pictures):
            raise DataError(f"{len(pictures)} episodes with pictures, {len(values)} with {name}")

    def read(number: int) -> Episode:
        name, of = f"episode {number}", pictures[number]
        cut = {key: table(values[number][:], name, key) for key, values in columns.items()}
        return Episode(name, of.shape[0], partial(_stream, of), **cut)

    names = [f"episode {number}" for number in range(len(pictures))]
    return Recording(episodes=[(n, partial(read, i)) for i, n in enumerate(names)], **about)


def _stream(pictures: Rows, start: int) -> Pictures:
    for at in range(start, pictures.shape[0], BLOCK):
        yield pictures[at : at + BLOCK]
