"""Episodes are cut into trajectories of one length, and held out whole."""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np

from hjepa_cli.core.arrays import Pixels
from hjepa_cli.core.datasets.importing.aligned import Aligned
from hjepa_cli.core.datasets.importing.pictures import as_pixels
from hjepa_cli.core.plants.resizing import fitted
from hjepa_cli.errors import DataError, UsageError
from hjepa_cli.storage.shards import Shard, cut

SHARD_BYTES = 64 * 2**20  # of frames
LEAST_STEPS = 2  # of a trajectory
UNREADABLE = (OSError, ValueError, KeyError)  # of libraries that read pictures


@dataclasses.dataclass(frozen=True, eq=False)
class Piece:
    """A trajectory of ``steps`` steps begins at row ``start`` of an episode."""

    of: Aligned
    start: int
    steps: int

    @property
    def rows(self) -> slice:
        """Return its rows; the first one is before k = 0."""
        return slice(self.start, self.start + self.steps + 1)


@dataclasses.dataclass(eq=False)
class Assembly:
    """It makes trajectories of episodes.

    Attributes:
        splits: pieces by split, in the order of their episodes.
        frame_shape: (H, W, C) of its frames.
        action_shape: A.
        skip_bad: leave out what cannot be read, and go on.
        said: what was converted, in words.
        bad: what was left out, in words.
    """

    splits: Mapping[str, Sequence[Piece]]
    frame_shape: tuple[int, int, int]
    action_shape: tuple[int, ...]
    skip_bad: bool = False
    said: set[str] = dataclasses.field(default_factory=set)
    bad: list[str] = dataclasses.field(default_factory=list)

    def shards(self) -> list[Shard]:
        """Return the files that the trajectories make, if none is bad."""
        longest = max(pieces[0].steps for pieces in self.splits.values()) + 1
        sizes = {split: len(pieces) for split, pieces in self.splits.items()}
        return cut(sizes, max(SHARD_BYTES // (math.prod(self.frame_shape) * longest), 1))

    def frames(self) -> int:
        """Return how many frames all trajectories have."""
        return sum(piece.steps + 1 for pieces in self.splits.values() for piece in pieces)

    def trajectories(self, shards: Sequence[Shard]) -> Iterator[tuple[Shard, dict[str, Any]]]:
        """Yield the arrays of each shard, without those that are bad; an episode is read once.

        Raises:
            DataError: a picture cannot be read, and ``skip_bad`` is off.
        """
        for split, of_split in groupby(shards, key=lambda shard: shard.split):
            pieces, some = self.splits[split], list(of_split)
            wanted = [piece for shard in some for piece in pieces[shard.start : shard.stop]]
            made = self._pieces(wanted)
            for shard in some:
                found = [next(made) for _ in range(shard.stop - shard.start)]
                good = [one for one in found if one is not None]
                keys = good[0] if good else ()
                yield shard, {key: np.stack([one[key] for one in good]) for key in keys}

    def _pieces(self, pieces: Sequence[Piece]) -> Iterator[dict[str, Any] | None]:
        """Yield the arrays of each piece; ``None`` where it is bad."""
        for _, group in groupby(pieces, key=lambda piece: id(piece.of)):
            some = list(group)
            made = frames_of_pieces(some, self.frame_shape, self.said)
            for number, piece in enumerate(some):
                try:
                    frames = next(made)
                except DataError as error:
                    if not self.skip_bad:
                        raise
                    self.bad.append(error.message)
                    yield from [None] * (len(some) - number)
                    break
                yield self._arrays(piece, frames)

    def _arrays(self, piece: Piece, frames: Pixels) -> dict[str, Any]:
        """Return tensors as a dataset has them."""
        rows, forces = piece.rows, (piece.steps, *self.action_shape)
        return {
            "states": piece.of.states[rows].astype(np.float32),
            "applied_n": piece.of.actions[rows][1:].astype(np.float32).reshape(forces),
            "teacher_n": piece.of.expert[rows][1:].astype(np.float32).reshape(forces),
            "frames": frames,
        }


def frames_of_pieces(
    pieces: Sequence[Piece], frame_shape: tuple[int, int, int], said: set[str]
) -> Iterator[Pixels]:
    """Yield the frames uint8 [steps + 1, H, W, C] of ascending pieces of one episode.

    ``said`` gets what was converted.

    Raises:
        DataError: a picture cannot be read, or there are too few.
    """
    episode, first = pieces[0].of.episode, pieces[0].of.first
    at = first + pieces[0].start  # of the first picture in ``held``
    blocks, held = episode.stream(at), np.empty((0, *frame_shape), np.uint8)
    for piece in pieces:
        start = first + piece.start
        if start > at + len(held):  # those between are there already
            blocks = episode.stream(start)
        held, at = held[start - at :], start
        read, rows = [held], len(held)
        while rows < piece.steps + 1:
            row = at + rows
            try:
                block = next(blocks)
            except StopIteration:
                raise DataError(
                    f"{episode.name}, row {row}: there is no picture; expected {episode.pictures}"
                ) from None
            except UNREADABLE as error:
                raise DataError(f"{episode.name}, row {row}: it cannot be read: {error}") from None
            pixels, converted = as_pixels(block, episode.name, row)
            said |= converted
            if pixels.shape[-1] < frame_shape[-1]:
                said.add("grey pictures became ones of three equal channels")
            if pixels.shape[-1] > frame_shape[-1]:
                said.add("colours became grey by their luma")
            if pixels.shape[1:3] != frame_shape[:2]:
                size = f"{pixels.shape[1]} × {pixels.shape[2]} px"
                said.add(f"pictures of {size} were resized by area")
            read.append(fitted(pixels, frame_shape))
            rows += len(read[-1])
        held = np.concatenate(read)
        yield held[: piece.steps + 1].copy()


def shared_steps(episodes: Sequence[Aligned], steps: int | None) -> int:
    """Return T: the one asked for, or as many steps as the shortest episode has.

    Raises:
        UsageError: no episode has so many.
    """
    longest = max(one.rows for one in episodes) - 1
    if steps is None:
        return min(one.rows for one in episodes) - 1
    if not LEAST_STEPS <= steps <= longest:
        raise UsageError(
            f"--steps {steps}: trajectories of {LEAST_STEPS} to {longest} steps can be cut from "
            "these episodes"
        )
    return steps


def pieces_of(episodes: Sequence[Aligned], steps: int) -> list[Piece]:
    """Cut episodes into pieces; the last one of each ends with it, and may overlap.

    Rows 0 and T of two neighbours are the same: one before the first step, one of the last.
    Episodes that are shorter give none.
    """
    found = []
    for one in episodes:
        last = one.rows - 1 - steps
        starts = sorted({*range(0, last + 1, steps), *([last] if last >= 0 else [])})
        found += [Piece(one, start, steps) for start in starts]
    return found


def held_out(episodes: Sequence[Aligned], share: float) -> tuple[list[Aligned], list[Aligned]]:
    """Return episodes to train on, and evenly spaced ones to test on; of a single one its end.

    Raises:
        UsageError: what it leaves of a single one is too short for a trajectory.
    """
    count = len(episodes)
    if count == 1:
        (whole,) = episodes
        tested = max(round(share * whole.rows), 1)
        rows = whole.rows - tested
        if min(rows, tested) < LEAST_STEPS + 1:
            raise UsageError(
                f"{whole.episode.name}: --held-out {share:g} leaves {rows} pictures to train on "
                f"and {tested} to test on; expected {LEAST_STEPS + 1} or more of each",
                hint="--held-out 0.5, a longer episode, or --test SOURCE",
            )
        return [whole.part(0, rows)], [whole.part(rows, whole.rows)]
    tests = min(max(round(share * count), 1), count - 1)
    chosen = {int((number + 0.5) * count / tests) for number in range(tests)}
    return (
        [one for number, one in enumerate(episodes) if number not in chosen],
        [one for number, one in enumerate(episodes) if number in chosen],
    )
