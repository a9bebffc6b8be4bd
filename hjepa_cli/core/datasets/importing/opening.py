"""The format of a recording is known by what lies at its path."""

from collections.abc import Callable, Mapping
from pathlib import Path

from hjepa_cli.core.datasets.importing import folder, hdf5, lerobot, npz, video
from hjepa_cli.core.datasets.importing.columns import Chosen
from hjepa_cli.core.datasets.importing.episode import Recording
from hjepa_cli.errors import MissingInputError, UsageError

FORMATS: Mapping[str, Callable[[Path, Chosen, str | None], Recording]] = {
    "folder": lambda path, chosen, camera: folder.read(path, chosen),
    "video": lambda path, chosen, camera: video.read(path, chosen),
    "npz": lambda path, chosen, camera: npz.read(path),
    "hdf5": lambda path, chosen, camera: hdf5.read(path),
    "lerobot": lerobot.read,
    "minari": lambda path, chosen, camera: hdf5.read_minari(path),
}
TABLES = ("folder", "video", "lerobot")  # whose columns can be chosen


def open_recording(path: Path, kind: str | None, chosen: Chosen, camera: str | None) -> Recording:
    """Open a recording; ``kind`` is one of :data:`FORMATS`, or ``None`` to see for itself.

    Raises:
        MissingInputError: there is nothing, or what reads it is not installed.
        UsageError: it is of no known format, or a column that was named is not there, or could not
            be.
        DataError: it is unsound.
    """
    if not path.exists():
        raise MissingInputError(f"{path} does not exist")
    kind = kind or format_of(path)
    if chosen != Chosen() and kind not in TABLES:
        raise UsageError(f"--actions, --states and --expert name columns; {path} is of {kind}")
    if camera is not None and kind != "lerobot":
        raise UsageError(f"--camera chooses among those of a LeRobotDataset; {path} is of {kind}")
    return FORMATS[kind](path, chosen, camera)


def format_of(path: Path) -> str:
    """Name the format of what lies at a path. Raises UsageError for none."""
    suffix = path.suffix.lower()
    if path.is_file():
        if suffix == ".npz":
            return "npz"
        if suffix in (".h5", ".hdf5"):
            return "hdf5"
        if suffix in video.SUFFIXES:
            return "video"
    elif (path / lerobot.INFO).is_file():
        return "lerobot"
    elif (path / hdf5.MINARI_FILE).is_file():
        return "minari"
    elif path.is_dir() and video.films_in(path):
        return "video"
    elif path.is_dir() and folder.csv_files(path):
        return "folder"
    raise UsageError(
        f"{path} is no recording: expected a folder of pictures with a CSV, films with a CSV each, "
        "NPZ, HDF5, a LeRobotDataset or a dataset of Minari"
    )
