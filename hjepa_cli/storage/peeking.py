"""Metadata of a file are read without the rest of it, and without relying on them."""

import contextlib
from collections.abc import Iterable
from pathlib import Path

from hjepa_cli.errors import HjepaError
from hjepa_cli.storage import files

MANIFEST = "dataset.json"


def plant_in(named: str | Path) -> str | None:
    """Return the plant that a dataset directory, a checkpoint or a run says it is of, if any."""
    path = Path(named)
    with contextlib.suppress(HjepaError, OSError, ValueError, LookupError, TypeError):
        if (path / MANIFEST).is_file():
            return str(files.read_json(path / MANIFEST)["plant"])
        # numpy comes with these: the command line waits for it only where there is a checkpoint.
        from hjepa_cli.storage import zoo
        from hjepa_cli.storage.tensors import HEADER_LIMIT_BYTES, METADATA_KEY

        with open(zoo.resolve_model(named), "rb") as file:
            length = int.from_bytes(file.read(8), "little")
            header = files.parse_json(file.read(min(length, HEADER_LIMIT_BYTES)))
        metadata = files.parse_json(header["__metadata__"][METADATA_KEY])
        return str(metadata["plant"])
    return None


def any_of(plant: str, named: Iterable[str | Path | None]) -> bool:
    """Tell whether one of some datasets, checkpoints or runs is of a plant."""
    return any(one is not None and plant_in(one) == plant for one in named)
