"""LeRobotDataset keeps tables in parquet and pictures in films; versions 2 and 3 are read.

Version 2 has a table and a film for each episode, version 3 puts several into one and says in
``meta/episodes`` where each begins.
"""

import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hjepa_cli.core.datasets.importing import video
from hjepa_cli.core.datasets.importing.columns import Chosen
from hjepa_cli.core.datasets.importing.episode import Entries, Episode, Pictures, Recording, table
from hjepa_cli.core.datasets.importing.folder import inside
from hjepa_cli.core.datasets.importing.pictures import decoded
from hjepa_cli.errors import DataError, UsageError, require

INFO = Path("meta") / "info.json"
STATE, ACTION, TIME = "observation.state", "action", "timestamp"
MALFORMED = (KeyError, ValueError, TypeError, IndexError, AttributeError)


def read(root: Path, chosen: Chosen, camera: str | None) -> Recording:
    """Open a dataset; ``camera`` names the feature with pictures where there are several.

    Raises:
        MissingInputError: pyarrow or PyAV is not installed.
        UsageError: no such camera, or there are several and none was named.
        DataError: it is of another version, or malformed.
    """
    require("pyarrow", "LeRobotDataset needs pyarrow", "import")
    require("av", "films need PyAV", "import")
    try:
        info = json.loads((root / INFO).read_text(encoding="utf-8"))
        version, features = str(info["codebase_version"]), dict(info["features"])
        fps = float(info["fps"])
        if not version.startswith(("v2", "v3")):
            raise DataError(f"{root} is of version {version}; expected v2 or v3")
        cameras = [name for name in features if features[name]["dtype"] in ("video", "image")]
        if ACTION not in features:
            raise DataError(f"{root} has no feature '{ACTION}'; it has {', '.join(features)}")
        key = _camera(cameras, camera, root)
        in_films = features[key]["dtype"] == "video"
        layout = _Layout(root, info, key, in_films, chosen)
        entries = layout.version_3() if version.startswith("v3") else layout.version_2()
        names = _names(features.get(STATE, {}))
    except (*MALFORMED, OSError) as error:
        raise DataError(f"{root} is no sound LeRobotDataset: {error!r}") from None
    return Recording("lerobot", entries, 1 / fps, state_names=names, lossy=in_films)


def _camera(cameras: list[str], wanted: str | None, root: Path) -> str:
    if wanted is None and len(cameras) == 1:
        return cameras[0]
    if wanted in cameras:
        return str(wanted)
    if not cameras:
        raise DataError(f"{root} has no camera among its features")
    asked = f"has no camera '{wanted}'" if wanted else "has several cameras"
    raise UsageError(f"{root} {asked}; --camera {', '.join(cameras)}")


def _names(feature: dict[str, Any]) -> tuple[str, ...]:
    """Return a name for each state, the feature's own where it has them."""
    if not feature:
        return ()
    (count,) = feature["shape"]
    names: Any = feature.get("names")
    if isinstance(names, dict):
        names = next(iter(names.values()), None)
    if not isinstance(names, list) or len(names) != count:
        names = [f"state_{number}" for number in range(count)]
    return tuple(map(str, names))


class _Layout:
    """Knows where the parts of an episode lie."""

    def __init__(
        self, root: Path, info: dict[str, Any], camera: str, in_films: bool, chosen: Chosen
    ) -> None:
        self._root, self._info, self._camera = root, info, camera
        self._in_films, self._chosen = in_films, chosen

    def version_2(self) -> Entries:
        per_chunk, entries = int(self._info.get("chunks_size", 1000)), []
        for number in range(int(self._info["total_episodes"])):
            name = f"episode {number}"
            place = {
                "episode_index": number,
                "episode_chunk": number // per_chunk,
                "video_key": self._camera,
            }
            files = [self._info["data_path"].format(**place)]
            if self._in_films:
                files.append(self._info["video_path"].format(**place))
            entries.append((name, partial(self._episode, name, number, files, 0.0)))
        return entries

    def version_3(self) -> Entries:
        entries = []
        for row in self._rows_of_episodes():
            number = int(row["episode_index"])
            name, films = f"episode {number}", f"videos/{self._camera}"
            place = {key: int(row[f"data/{key}"]) for key in ("chunk_index", "file_index")}
            files, from_s = [self._info["data_path"].format(**place)], 0.0
            if self._in_films:
                place = {key: int(row[f"{films}/{key}"]) for key in place}
                path = self._info["video_path"].format(video_key=self._camera, **place)
                files.append(path)
                from_s = float(row[f"{films}/from_timestamp"])
            entries.append((name, partial(self._episode, name, number, files, from_s)))
        return entries

    def _rows_of_episodes(self) -> Iterator[dict[str, Any]]:
        import pyarrow.parquet as parquet

        for path in sorted((self._root / "meta" / "episodes").rglob("*.parquet")):
            found = parquet.read_table(path)
            wanted = [name for name in found.column_names if not name.startswith("stats/")]
            yield from found.select(wanted).to_pylist()

    def _episode(self, name: str, number: int, files: list[str], from_s: float) -> Episode:
        import pyarrow
        import pyarrow.parquet as parquet

        paths = [inside(self._root, file, name) for file in files]
        states = self._info["features"].get(STATE)
        expert = list(self._chosen.expert or ())
        wanted = [ACTION, TIME, *([STATE] if states else []), *expert]
        wanted += [] if self._in_films else [self._camera]
        try:
            only = [("episode_index", "=", number)]
            found = parquet.read_table(paths[0], columns=wanted, filters=only)
        except (pyarrow.ArrowException, OSError, *MALFORMED) as error:
            raise DataError(f"{name}: {paths[0]} cannot be read: {error}") from None
        column = {key: found[key].to_pylist() for key in wanted if key != self._camera}
        count = len(column[TIME])
        stream: Callable[[int], Pictures]
        if self._in_films:
            stream = partial(_of_film, paths[1], name, count, from_s)
        else:
            stream = partial(_of_table, found[self._camera], name)
        return Episode(
            name,
            count,
            stream,
            actions=table(column[ACTION], name, "actions"),
            states=table(column[STATE], name, "states") if states else None,
            expert=table(column[expert[0]], name, "expert actions") if expert else None,
            times_s=np.asarray(column[TIME], dtype=float),
        )


def _of_film(path: Path, name: str, count: int, from_s: float, start: int) -> Pictures:
    """Yield the episode's own pictures of a film that may go on with the next."""
    for number, picture in enumerate(video.stream(path, name, start, from_s=from_s), start=start):
        if number == count:
            return
        yield picture


def _of_table(column: Any, name: str, start: int) -> Pictures:
    """Yield pictures that lie encoded in a column."""
    for row in range(start, len(column)):
        value, where = column[row].as_py(), f"{name}, row {row}"
        if not (isinstance(value, dict) and isinstance(value.get("bytes"), bytes)):
            raise DataError(f"{where}: there is no picture in the table")
        yield decoded(value["bytes"], where)[None]
