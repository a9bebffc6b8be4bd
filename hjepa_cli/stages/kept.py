"""A run keeps what it measured in a sealed file as it goes: an interruption loses little."""

from pathlib import Path
from typing import Any

from hjepa_cli.core.control.link import LINK_VERSION
from hjepa_cli.core.control.loop import LOOP_VERSION
from hjepa_cli.errors import DataError
from hjepa_cli.storage import files, seals

SCHEMA = 1
VERSIONS = {"loop_version": LOOP_VERSION, "link_version": LINK_VERSION}


class Kept:
    """Holds rows by key, those of an interrupted run from its file; none of another version.

    Raises:
        DataError: the file was changed, or holds no rows.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._rows: dict[str, Any] = {}
        if not path.exists():
            return
        again = f"delete {path} to measure them again"
        document = seals.read(path, SCHEMA, again)
        if any(document.get(name) != version for name, version in VERSIONS.items()):
            return
        rows = document.get("rows")
        if not isinstance(rows, dict):
            raise DataError(f"{path} holds no rows", hint=again)
        self._rows = rows

    def __contains__(self, key: str) -> bool:
        return key in self._rows

    def __getitem__(self, key: str) -> Any:
        return self._rows[key]

    def add(self, key: str, row: Any) -> None:
        """Write a row, at once; from here on it is what the file says, and so the same later."""
        self._rows[key] = files.jsonable(row)
        document = {"schema": SCHEMA, **VERSIONS, "rows": self._rows}
        files.write_json(self._path, seals.sealed(document))
