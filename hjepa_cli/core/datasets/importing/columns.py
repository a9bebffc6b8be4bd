"""CSV files have a row per picture; columns are named in their first line."""

import csv
import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hjepa_cli.core.arrays import Floats
from hjepa_cli.errors import DataError, MissingInputError, UsageError

TIMES = ("time_s", "timestamp", "time")
EPISODE, PICTURE = "episode", ("frame", "file", "image", "picture")
SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")  # of pictures
SEPARATORS = ";\t|"  # of other dialects
BEGINNINGS = {"actions": "action", "states": "state", "expert": "expert"}


@dataclasses.dataclass(frozen=True)
class Chosen:
    """These columns were named by a person; ``None`` goes by how they begin."""

    actions: tuple[str, ...] | None = None
    states: tuple[str, ...] | None = None
    expert: tuple[str, ...] | None = None


@dataclasses.dataclass(frozen=True)
class Table:
    """A CSV file as text, with the names of its columns by what they hold.

    ``lines`` are the numbers of its rows in the file, where lines may be blank.
    """

    path: Path
    header: list[str]
    rows: list[list[str]]
    lines: list[int]
    groups: dict[str, list[str]]

    @property
    def picture(self) -> str | None:
        """Return the column that names picture files, by its name or by what is in it."""
        columns = zip(self.header, zip(*self.rows, strict=True), strict=False)
        files = (name for name, of in columns if all(one.lower().endswith(SUFFIXES) for one in of))
        return self._called(PICTURE) or next(files, None)

    @property
    def time(self) -> str | None:
        """Return the column of times in seconds, if there is one."""
        return self._called(TIMES)

    def episodes(self) -> dict[str, list[int]]:
        """Return the rows of each episode by its name, in order; all of one without a column."""
        column = self._called((EPISODE,))
        if column is None or not self.rows:
            return {"": list(range(len(self.rows)))}
        place, found = self.header.index(column), dict[str, list[int]]()
        for number, row in enumerate(self.rows):
            found.setdefault(row[place], []).append(number)
        return found

    def texts(self, column: str, rows: Sequence[int]) -> list[str]:
        """Return a column as it is written."""
        place = self.header.index(column)
        return [self.rows[row][place] for row in rows]

    def numbers(self, columns: Sequence[str], rows: Sequence[int]) -> Floats:
        """Return columns as float64 [rows, columns]; empty places are NaN.

        Raises:
            DataError: something is no number; it names the line.
        """
        values = np.empty((len(rows), len(columns)))
        for at, column in enumerate(columns):
            for place, text in enumerate(self.texts(column, rows)):
                try:
                    values[place, at] = float(text) if text.strip() else math.nan
                except ValueError:
                    line = self.lines[rows[place]]
                    raise DataError(
                        f"{self.path}, line {line}: {column} = {text!r} is no number"
                    ) from None
        return values

    def _called(self, names: Sequence[str]) -> str | None:
        """Return the column of the first of some names that there is, in capitals or not."""
        spelt = {name.lower(): name for name in reversed(self.header)}
        return next((spelt[name] for name in names if name in spelt), None)

    @property
    def chosen(self) -> Chosen:
        """Return what chooses the same columns in another table."""
        return Chosen(*(tuple(self.groups[key]) for key in BEGINNINGS))


def read(path: Path, chosen: Chosen) -> Table:
    """Read a CSV file.

    Raises:
        MissingInputError: there is none.
        UsageError: a column that was named is not in it.
        DataError: it is none, or separated otherwise; a line has another number of columns, two
            columns have one name, or none is an action's.
    """
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True)
            written = [(reader.line_num, row) for row in reader if not _blank(row)]
        (_, header), *below = written
    except FileNotFoundError:
        raise MissingInputError(f"{path} does not exist") from None
    except (OSError, ValueError, csv.Error) as error:
        raise DataError(f"{path} is no CSV file with a header: {error}") from None
    header = [name.strip() for name in header]
    for separator in SEPARATORS:
        if len(header) == 1 and separator in header[0]:
            raise DataError(f"{path}: columns are separated by {separator!r}, expected ','")
    for name in header:
        if name and header.count(name) > 1:
            raise DataError(
                f"{path} has {header.count(name)} columns '{name}'; expected different names"
            )
    for number, row in below:
        if len(row) != len(header):
            raise DataError(
                f"{path}, line {number}: {len(row)} columns; the header has {len(header)}"
            )
    groups = {}
    for key, beginning in BEGINNINGS.items():
        named = getattr(chosen, key)
        for name in named or ():
            if name not in header:
                raise UsageError(f"{path} has no column '{name}'; it has {', '.join(header)}")
        found = [name for name in header if name.lower().startswith(beginning)]
        groups[key] = list(named) if named is not None else found
    if not groups["actions"]:
        raise DataError(
            f"{path} has no column whose name begins with action; it has {', '.join(header)}",
            hint="--actions A,B names the columns of actions",
        )
    return Table(path, header, [row for _, row in below], [line for line, _ in below], groups)


def _blank(row: list[str]) -> bool:
    return len(row) < 2 and not "".join(row).strip()
