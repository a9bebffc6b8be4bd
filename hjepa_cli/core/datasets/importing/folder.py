"""A folder holds pictures and a CSV with a row for each; or a folder of that kind per episode."""

import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from hjepa_cli.core.datasets.importing import columns
from hjepa_cli.core.datasets.importing.columns import SUFFIXES, Chosen, Table
from hjepa_cli.core.datasets.importing.episode import Episode, Pictures, Recording
from hjepa_cli.core.datasets.importing.pictures import decoded
from hjepa_cli.errors import DataError, require

LOSSY = (".jpg", ".jpeg", ".webp")


def read(directory: Path, chosen: Chosen) -> Recording:
    """Open a folder: one CSV in it, or one in each of its folders.

    The column ``frame`` names each row's picture; without it the pictures beside the CSV are taken
    in the order of their names. Rows with different entries in ``episode`` are different episodes.

    Raises:
        MissingInputError: Pillow is not installed.
        DataError: there is no CSV, or an unsound one.
    """
    require("PIL", "pictures need Pillow", "import")
    tables: list[tuple[Path, Table]] = []
    for path in csv_files(directory):  # the first says which columns are an action's in all
        alike = tables[0][1].chosen if tables else chosen
        tables.append((path, columns.read(path, alike)))
    if not tables:
        raise DataError(f"{directory} and its folders hold no CSV file")
    entries: list[tuple[str, Callable[[], Episode]]] = []
    for path, table in tables:
        for name, rows in table.episodes().items():
            place = path.relative_to(directory)
            called = f"episode {name} of {place}" if name else f"episode {place}"
            entries.append((called, partial(_episode, called, directory, table, rows)))
    _, first = tables[0]
    lossy = any(path.suffix.lower() in LOSSY for path in _beside(tables[0][0]))
    names = tuple(first.groups["states"])
    return Recording("folder", entries, state_names=names, lossy=lossy)


def csv_files(directory: Path) -> list[Path]:
    """Return the CSV files in a folder, else those in its folders, by name."""
    return sorted(directory.glob("*.csv")) or sorted(directory.glob("*/*.csv"))


def of_table(table: Table, rows: Sequence[int]) -> dict[str, Any]:
    """Return what the rows of a table say of an episode. Raises DataError where it has none."""
    if not rows:
        raise DataError(f"{table.path} has a header and no rows")
    said: dict[str, Any] = {
        key: table.numbers(names, rows) for key, names in table.groups.items() if names
    }
    if table.time:
        said["times_s"] = table.numbers([table.time], rows)[:, 0]
    return said


def inside(root: Path, name: str, what: str) -> Path:
    """Return the path that a file names, below ``root``.

    Raises:
        DataError: it leads elsewhere, or there is nothing; the message begins with ``what``.
    """
    path = root / name
    if not name or Path(name).is_absolute() or not path.resolve().is_relative_to(root.resolve()):
        raise DataError(f"{what}: '{name}' leads out of {root}")
    if not path.is_file():
        raise DataError(f"{what}: {path} does not exist")
    return path


def _episode(name: str, root: Path, table: Table, rows: list[int]) -> Episode:
    said, column = of_table(table, rows), table.picture
    if column is None:
        paths = _beside(table.path)
        whole = len(table.rows)
        if len(paths) < whole:
            raise DataError(
                f"{name}: {whole} rows and {len(paths)} pictures: the one of row {len(paths)} is "
                "missing"
            )
        paths = [paths[row] for row in rows] if len(rows) < whole else paths
    else:
        written = table.texts(column, rows)
        paths = [
            inside(root, str(table.path.parent.relative_to(root) / text), f"{name}, row {place}")
            for place, text in enumerate(written)
        ]
    return Episode(name, len(paths), partial(_stream, name, paths), **said)


def _beside(path: Path) -> list[Path]:
    """Return the pictures beside a table; ``9.png`` comes before ``10.png``."""
    found = (one for one in path.parent.iterdir() if one.suffix.lower() in SUFFIXES)
    return sorted(found, key=lambda one: re.sub(r"\d+", lambda of: of[0].zfill(20), one.name))


def _stream(name: str, paths: Sequence[Path], start: int) -> Pictures:
    for row in range(start, len(paths)):
        yield decoded(paths[row], f"{name}, row {row}")[None]
