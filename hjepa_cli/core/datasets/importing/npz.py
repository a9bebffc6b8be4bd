"""NPZ files are read member by member and row by row: neither pickle nor all pictures at once."""

import json
import math
import re
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.core.datasets.importing import arrays
from hjepa_cli.core.datasets.importing.episode import Recording
from hjepa_cli.errors import DataError

COLUMN_BYTES = 2**31  # of what is read at once: actions, states
SKIP_BYTES = 2**20
COLUMNS = {  # what we call a column, and what others do
    "actions": ("actions", "action"),
    "states": ("states", "state"),
    "expert": ("expert_actions", "expert_action", "teacher_action", "expert"),
}
PICTURES = ("frames", "pixels")
ABOUT = "hjepa"  # what an export of ours says of itself
BROKEN = (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, KeyError)


class Member:
    """The array of a member has rows that are read in order; going back begins anew.

    With ``flat`` its first two axes count as one.

    Raises:
        DataError: it is no array of numbers.
    """

    def __init__(self, archive: "_Archive", name: str, *, flat: bool = False) -> None:
        self._archive, self._name, self._at = archive, name, 0
        self.whole = self._open()
        self.shape = self.whole
        if flat:
            self.shape = (math.prod(self.whole[:2]), *self.whole[2:])
        self._row_bytes = self._dtype.itemsize * math.prod(self.shape[1:])

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        start, stop, _ = rows.indices(self.shape[0])
        try:
            if start < self._at:
                self._open()
            left = (start - self._at) * self._row_bytes
            while left:
                left -= len(self._take(min(left, SKIP_BYTES)))
            data = self._take((stop - start) * self._row_bytes)
        except BROKEN as error:
            raise DataError(f"{self._name}, row {start} or later: {error}") from None
        self._at = stop
        return np.frombuffer(data, self._dtype).reshape(stop - start, *self.shape[1:])

    def all(self) -> NDArray[Any]:
        """Return the whole array. Raises DataError where it is unreasonably large."""
        size = self._row_bytes * self.shape[0]
        if size > COLUMN_BYTES:
            raise DataError(f"{self._name} holds {size} bytes; expected columns of numbers")
        return self[:]

    def _open(self) -> tuple[int, ...]:
        """Go to the first row, and return the shape."""
        try:
            self._stream = self._archive.stream(self._name)
            version = np.lib.format.read_magic(self._stream)
            newer = version == (2, 0)
            read = np.lib.format.read_array_header_2_0 if newer else _read_first_header
            shape, in_columns, self._dtype = read(self._stream)
        except BROKEN as error:
            raise DataError(f"{self._name} is no array: {error}") from None
        if self._dtype.hasobject:
            raise DataError(
                f"{self._name} holds pickled objects, which are never loaded",
                hint="save an array for each episode: frames_0, actions_0, frames_1, …",
            )
        if in_columns or not shape:
            raise DataError(f"{self._name} has shape {shape}; expected rows in C order")
        self._at = 0
        return tuple(shape)

    def _take(self, count: int) -> bytes:
        data = self._stream.read(count)
        if len(data) != count:
            raise EOFError("the file ends too early")
        return data


_read_first_header = np.lib.format.read_array_header_1_0


def read(path: Path) -> Recording:
    """Open an NPZ.

    It has either ``frames`` [N, T + 1, H, W, C], ``actions`` [N, T, A] and perhaps ``states`` and
    ``expert_actions``; or ``frames_0``, ``actions_0``, … of each episode; or the columns of ``hjepa
    data export``, with ``ep_len``.

    Raises:
        DataError: it is none, or an array is missing.
    """
    try:
        archive = _Archive(path)
    except (zipfile.BadZipFile, OSError) as error:
        raise DataError(f"{path} is no NPZ file: {error}") from None
    try:
        return _read(path, archive)
    except BaseException:
        archive.close()
        raise


class _Archive(zipfile.ZipFile):
    """It closes with it what was opened in it."""

    def __init__(self, path: Path) -> None:
        self._streams: dict[str, IO[bytes]] = {}
        super().__init__(path)

    def stream(self, name: str) -> IO[bytes]:
        """Open a member from its beginning, in place of what was opened of it before."""
        if name in self._streams:
            self._streams[name].close()
        self._streams[name] = self.open(f"{name}.npy")
        return self._streams[name]

    def close(self) -> None:
        """Close all of it."""
        for stream in self._streams.values():
            stream.close()
        super().close()


def _read(path: Path, archive: _Archive) -> Recording:
    names = [name.removesuffix(".npy") for name in archive.namelist()]
    about = {"format": "npz", "close": archive.close, **_described(archive, names)}

    def found(suffix: str = "") -> dict[str, str]:
        """Return the members of our columns that there are."""
        offered = {key: [f"{one}{suffix}" for one in choices] for key, choices in COLUMNS.items()}
        there = {key: [one for one in some if one in names] for key, some in offered.items()}
        if not there["actions"]:
            raise DataError(
                f"{path} has no {offered['actions'][0]}; it has {', '.join(names) or 'nothing'}"
            )
        return {key: some[0] for key, some in there.items() if some}

    matches = (re.fullmatch(r"frames(_\d{1,9})", name) for name in names)
    suffixes = sorted((match[1] for match in matches if match), key=lambda of: int(of[1:]))
    if suffixes:
        members = [found(suffix) for suffix in suffixes]
        columns = {
            key: [Member(archive, one[key]).all() for one in members if key in one]
            for key in COLUMNS
            if any(key in one for one in members)
        }
        pictures = [Member(archive, f"frames{suffix}") for suffix in suffixes]
        return arrays.recording(pictures, columns, **about)
    name = next((one for one in PICTURES if one in names), None)
    if name is None:
        raise DataError(f"{path} has no frames; it has {', '.join(names) or 'nothing'}")
    values = {key: Member(archive, one).all() for key, one in found().items()}
    if "ep_len" in names:
        lengths = Member(archive, "ep_len").all().astype(int).ravel().tolist()
        cut = {key: arrays.parts(column, lengths, key) for key, column in values.items()}
        pixels = arrays.parts(Member(archive, name), lengths, name)
        return arrays.recording(pixels, cut, **about)
    frames = Member(archive, name, flat=True)
    if len(frames.whole) < 4:
        raise DataError(
            f"{path}: {name} have shape {frames.whole}; expected [N, T + 1, H, W, C], or ep_len "
            "beside them"
        )
    count, length, *_ = frames.whole
    return arrays.recording(
        arrays.parts(frames, [length] * count, name),
        {key: list(column) for key, column in values.items()},
        **about,
    )


def _described(archive: _Archive, names: list[str]) -> dict[str, Any]:
    if ABOUT not in names:
        return {}
    try:
        with archive.open(f"{ABOUT}.npy") as file:
            said = np.lib.format.read_array(file)
        return exported(json.loads(str(said)))
    except (*BROKEN, TypeError):
        return {}


def exported(said: dict[str, Any]) -> dict[str, Any]:
    """Return what an export of ours says of a recording; its actions are ÷ their limits."""
    names, count = tuple(said.get("states", ())), int(said.get("actions", 1))
    return {"step_s": float(said["step_s"]), "state_names": names, "limits": (1.0,) * count}
