"""A film has a CSV of the same name beside it, with a row for each of its pictures."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from hjepa_cli.core.datasets.importing import columns
from hjepa_cli.core.datasets.importing.columns import Chosen
from hjepa_cli.core.datasets.importing.episode import Episode, Pictures, Recording
from hjepa_cli.core.datasets.importing.folder import of_table
from hjepa_cli.errors import DataError, require

SUFFIXES = (".mp4", ".mkv", ".avi", ".mov", ".webm")
LOSSLESS = ("ffv1", "png", "rawvideo", "huffyuv", "ffvhuff")


def read(path: Path, chosen: Chosen) -> Recording:
    """Open a film, or all films of a folder, each an episode.

    Raises:
        MissingInputError: PyAV is not installed.
        DataError: a film does not decode, or is of another frame rate than the first.
    """
    require("av", "films need PyAV", "import")
    films = [path] if path.is_file() else films_in(path)
    rates = {_about(film)["rate"] for film in films}
    if len(rates) > 1:
        raise DataError(
            f"{path}: films of {' and '.join(f'{rate:g}' for rate in sorted(rates))} pictures a "
            "second; expected one rate",
            hint="import them one by one",
        )
    alike = columns.read(films[0].with_suffix(".csv"), chosen).chosen
    entries: list[tuple[str, Callable[[], Episode]]] = []
    for film in films:
        name = f"episode {film.name}"
        entries.append((name, partial(_episode, name, film, alike)))
    names = alike.states or ()
    lossy = any(_about(film)["codec"] not in LOSSLESS for film in films)
    return Recording("video", entries, 1 / rates.pop(), state_names=names, lossy=lossy)


def films_in(directory: Path) -> list[Path]:
    """Return the films of a folder by name."""
    return sorted(one for one in directory.iterdir() if one.suffix.lower() in SUFFIXES)


def _episode(name: str, film: Path, chosen: Chosen) -> Episode:
    table = columns.read(film.with_suffix(".csv"), chosen)
    rows = list(range(len(table.rows)))
    times_s = times_of(film, name)
    said = {"times_s": times_s, **of_table(table, rows)}
    return Episode(name, len(times_s), partial(stream, film, name), **said)


def _about(film: Path) -> dict[str, Any]:
    import av

    try:
        with av.open(str(film)) as container:
            one = container.streams.video[0]
            rate = float(one.average_rate or 0)
            return {"rate": rate, "codec": one.codec_context.name}
    except (av.FFmpegError, OSError, IndexError, ValueError) as error:
        raise DataError(f"{film} does not decode: {error}") from None


def times_of(film: Path, name: str) -> list[float]:
    """Return when each picture is shown [s], without decoding it.

    Raises:
        DataError: the film is broken.
    """
    import av

    try:
        with av.open(str(film)) as container:
            one = container.streams.video[0]
            base = float(one.time_base or 1)
            return sorted(
                packet.pts * base for packet in container.demux(one) if packet.pts is not None
            )
    except (av.FFmpegError, OSError, IndexError, ValueError) as error:
        raise DataError(f"{name}: {film} does not decode: {error}") from None


def stream(film: Path, name: str, start: int, *, from_s: float = 0.0) -> Pictures:
    """Yield the pictures of a film from one on, RGB [1, H, W, 3] each.

    Those before ``from_s`` do not count.

    Raises:
        DataError: one does not decode; it says which.
    """
    import av

    row = 0
    try:
        with av.open(str(film)) as container:
            one = container.streams.video[0]
            one.thread_type = "AUTO"
            if from_s > 0 and one.time_base:
                container.seek(int(from_s / one.time_base), stream=one)
            for picture in container.decode(one):
                if picture.time is not None and picture.time < from_s - 1e-4:
                    continue
                if row >= start:
                    yield picture.to_ndarray(format="rgb24")[None]
                row += 1
    except (av.FFmpegError, OSError, IndexError, ValueError) as error:
        raise DataError(f"{name}, row {row}: {film} does not decode: {error}") from None
