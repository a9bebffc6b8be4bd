"""HDF5 files are those of stable-worldmodel and of ``hjepa data export``, or of Minari.

stable-worldmodel's has a row per picture in ``pixels``, ``action`` and, if there are any, ``state``
(or ``proprio``) and ``expert_action`` (or ``teacher_action``), and ``ep_len``. Minari's has a group
``episode_<n>`` for each episode with ``observations`` and ``actions``.
"""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.core.datasets.importing import arrays
from hjepa_cli.core.datasets.importing.episode import Recording
from hjepa_cli.core.datasets.importing.npz import ABOUT, COLUMNS, exported
from hjepa_cli.core.datasets.importing.pictures import decoded
from hjepa_cli.errors import DataError, require

PICTURES = ("pixels", "frames")
OTHERS = {**COLUMNS, "states": (*COLUMNS["states"], "proprio")}
MINARI_FILE = Path("data") / "main_data.hdf5"
MINARI_PICTURES = ("pixels", "image", "images", "rgb", "frames")


def read(path: Path) -> Recording:
    """Open a file in stable-worldmodel's layout.

    Raises:
        MissingInputError: h5py is not installed.
        DataError: the file has another layout.
    """
    with _opened(path) as file:
        names = list(file)
        pictures = next((file[name] for name in PICTURES if name in names), None)
        found = {
            key: file[name]
            for key, choices in OTHERS.items()
            for name in reversed(choices)
            if name in names
        }
        if pictures is None or "actions" not in found or "ep_len" not in names:
            raise DataError(
                f"{path} lacks pixels, action or ep_len; it has {', '.join(names) or 'nothing'}"
            )
        lengths = file["ep_len"][:].astype(int).ravel().tolist()
        columns = {key: arrays.parts(column, lengths, key) for key, column in found.items()}
        about: dict[str, Any] = {"format": "hdf5", "close": file.close}
        if ABOUT in file.attrs:
            try:
                about |= exported(json.loads(file.attrs[ABOUT]))
            except (ValueError, TypeError, KeyError):
                pass  # somebody else's attribute of this name
        return arrays.recording(arrays.parts(pictures, lengths, "pixels"), columns, **about)


def read_minari(directory: Path) -> Recording:
    """Open a dataset of Minari, whose observations are pictures or have some among them.

    Raises:
        MissingInputError: h5py is not installed.
        DataError: the file has another layout, or no pictures.
    """
    require("PIL", "pictures need Pillow", "import")
    with _opened(directory / MINARI_FILE) as file:
        numbers = sorted(int(name[8:]) for name in file if name.startswith("episode_"))
        groups = [file[f"episode_{number}"] for number in numbers]
        if not groups:
            raise DataError(f"{directory} holds no episodes")
        pictures = [_pictures(group["observations"], directory) for group in groups]
        columns = {"actions": [group["actions"] for group in groups]}
        about: dict[str, Any] = {"format": "minari", "close": file.close, **_space(directory)}
        lossy = any(isinstance(some, _Encoded) for some in pictures)
        return arrays.recording(pictures, columns, lossy=lossy, **about)


class _Encoded:
    """Pictures that lie in a column as files, JPEG of Minari's, are rows."""

    def __init__(self, column: Any) -> None:
        self._column = column
        self.shape = column.shape

    @property
    def holds_pictures(self) -> bool:
        """Tell whether the column holds bytes of any length, and not numbers."""
        return bool(self._column.dtype.hasobject and self.shape[0])

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        start, stop, _ = rows.indices(self.shape[0])
        files = self._column[start:stop]
        name = self._column.name.strip("/").partition("/")[0].replace("_", " ")
        found = [
            decoded(bytes(file), f"{name}, row {row}")
            for row, file in enumerate(files, start=start)
        ]
        return np.stack(found)


def _pictures(observations: Any, directory: Path) -> Any:
    """Return the pictures among the observations of an episode."""
    if isinstance(observations, Mapping):
        named = {name: observations[name] for name in observations}
    else:
        named = {"observations": observations}
    chosen = {name: of for name, of in named.items() if len(getattr(of, "shape", ())) >= 3}
    encoded = {name: _Encoded(of) for name, of in named.items() if getattr(of, "ndim", 0) == 1}
    chosen |= {name: of for name, of in encoded.items() if of.holds_pictures}
    for name in (*MINARI_PICTURES, *chosen):
        if name in chosen:
            return chosen[name]
    raise DataError(f"{directory}: no pictures among the observations {', '.join(named)}")


def _space(directory: Path) -> dict[str, Any]:
    """Return the limits that the action space states, if it is a symmetric box."""
    try:
        metadata = json.loads((directory / "data" / "metadata.json").read_text(encoding="utf-8"))
        space = metadata["action_space"]
        space = json.loads(space) if isinstance(space, str) else space
        low, high = (np.asarray(space[end], dtype=float).ravel() for end in ("low", "high"))
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    symmetric = high.size and np.isfinite(high).all() and (high > 0).all() and (low == -high).all()
    return {"limits": tuple(high.tolist())} if symmetric else {}


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a file, which stays open where all goes well: pictures are read from it later."""
    require("h5py", "HDF5 needs h5py", "hdf5")
    import h5py

    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise DataError(f"{path} is no HDF5 file: {error}") from None
    try:
        yield file
    except (OSError, KeyError, ValueError, TypeError, AttributeError) as error:
        file.close()
        raise DataError(f"{path} has another layout: {error}") from None
    except BaseException:
        file.close()
        raise
