"""``hjepa data info | verify | preview | export`` tells what a dataset is, and if it is intact."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hjepa_cli.compute import memory
from hjepa_cli.config.schema import RECORDED
from hjepa_cli.core.datasets import exports
from hjepa_cli.core.datasets.dataset import (
    MANIFEST,
    Dataset,
    Trajectories,
    find_newest_dataset,
    load_dataset,
)
from hjepa_cli.core.plants.control_law import control_law, control_of
from hjepa_cli.core.plants.frames import Camera, frames_of
from hjepa_cli.core.plants.named import camera_in, camera_of, sensor_in
from hjepa_cli.core.plants.recorded import Recorded
from hjepa_cli.core.plants.system import System
from hjepa_cli.errors import HjepaError, MissingInputError, UsageError, require, together
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages.plan import Plan, seconds_of, size
from hjepa_cli.storage import files

Result = dict[str, Any]

ROOT = Path("data")
FORMATS = {"hdf5": (".h5", ".hdf5"), "npz": (".npz",)}  # the first suffix is written by default
COMPRESSED_FRAME_BYTES = 700


def show_info(screen: Screen, path: Path | None) -> Result:
    """Describe a dataset from its manifest. Raise MissingInputError or DataError."""
    data = open_dataset(path, screen)
    result = summary(data)
    rows = {
        "plant": data.plant,
        **({} if data.plant == RECORDED else {"seed": data.settings.get("seed")}),
        "frames": data.frames,
        "camera version": data.camera.get("version"),
        "on disk": size(result["size_bytes"]),
        "sha256": data.digest,
    }
    for name, split in result["splits"].items():
        trajectories = f"{split['trajectories']} trajectories of {split['steps']} steps"
        rows[name] = f"{trajectories} in {split['shards']} shards"
    collected = data.settings.get("collect", {})
    rows |= {f"collect.{key}": value for key, value in collected.items() if key != "plant"}
    for section in ("recorded", "camera", "import"):
        said = data.settings.get(section, {})
        rows |= {f"{section}.{key}": _shown(value) for key, value in said.items()}
    screen.table(f"Dataset {data.path}", ["", "value"], list(rows.items()))
    return {**result, "config": data.settings, "camera": data.camera}


def verify(screen: Screen, paths: Sequence[Path]) -> Result:
    """Read every shard and check sha256, shapes and values; all of data/ if none is named.

    Raise MissingInputError without any, and, after all of them, the error of the first shard or
    dataset that is damaged or unreadable, which names the others too.
    """
    wanted = list(paths) or [
        ROOT / name for name in files.list_names(ROOT) if (ROOT / name / MANIFEST).exists()
    ]
    if not wanted:
        raise MissingInputError(f"no dataset in {ROOT}/", hint="hjepa collect")
    damaged: list[HjepaError] = []
    verified = []
    for path in wanted:
        try:
            data = load_dataset(path)
            flaws = list(data.flaws())
            damaged += flaws
            if flaws:
                continue
            ranges = {name: spread(data.split(name)) for name in data.splits}
        except HjepaError as error:
            damaged.append(error)
            continue
        verified.append({**summary(data), "states": ranges})
        screen.table(
            f"{path}: intact, sha256 {data.digest}",
            ["split", *labels(data.kind)],
            [
                [name, *(f"{least:.3g} … {most:.3g}" for least, most in spans)]
                for name, spans in ranges.items()
            ],
        )
    if damaged:
        raise together(damaged)
    return {"verified": verified}


def preview(
    screen: Screen, path: Path | None, out: Path | None, split: str, rows: int, columns: int
) -> Result:
    """Draw a contact sheet: one trajectory per row, time from left to right.

    Raise UsageError for another file than a PNG, MissingInputError without a dataset or Pillow, and
    DataError for a damaged dataset.
    """
    require("PIL", "a preview needs Pillow", "plot")
    from hjepa_cli.output import pictures

    if out is not None and out.suffix != ".png":
        raise UsageError(f"a preview is a PNG file, not '{out.suffix}'; --out FILE.png")
    data = open_dataset(path, screen)
    recorded = data.split(split)[:rows]
    steps = np.linspace(0, recorded.steps - 1, min(columns, recorded.steps)).round().astype(int)
    if recorded.frames is None:
        frames = frames_of(data_camera(data), recorded.states[:, steps + 1])
    else:
        frames = recorded.frames[:, steps + 1]
    kind, driven_n = data.kind, recorded.applied_n
    captions = [
        [f"{split} {row}, k {step}, {forces(driven_n[row, step], kind)}" for step in steps]
        for row in range(len(recorded))
    ]
    target = files.target(out or Path(f"{data.path.name}-{split}.png"))
    pictures.save_png(pictures.contact_sheet(frames, captions), target)
    screen.say(f"{len(recorded)} trajectories of {data.path}: {target}")
    return {"dataset": str(data.path), "split": split, "picture": str(target)}


def export(
    screen: Screen, path: Path | None, out: Path | None, split: str, kind: str | None, pixels: bool
) -> Result:
    """Write one split for other programs; see :mod:`hjepa_cli.core.datasets.exports`.

    Raise UsageError for another format, and MissingInputError without a dataset or h5py.
    """
    kind = chosen_format(out, kind)
    data = open_dataset(path, screen)
    memory.check(held_bytes(data, split), f"split '{split}' of {data.path}")
    recorded = data.split(split)
    target = files.target(out or Path(f"{data.path.name}-{split}{FORMATS[kind][0]}"))
    system = data.kind
    limit_n, camera = system.force_limit_n, data_camera(data)
    if data.plant == RECORDED:  # nobody knows what the expert would have done before
        before_n = np.zeros_like(recorded.teacher_n[:, 0])
    else:
        act = control_law(system, control_of(data.settings, data.path))
        before_n = act(recorded.states[:, 0])
    values = exports.columns(recorded, before_n, limit_n)
    about = {
        "dataset": data.digest,
        "plant": data.plant,
        "split": split,
        "camera": data.camera,
        "force_limit_n": limit_n,
        "step_s": system.step_s,
        "states": list(system.state_names),
        "actions": math.prod(system.action_shape),
    }

    def film(part: Trajectories) -> np.ndarray:
        return frames_of(camera, part.states) if part.frames is None else part.frames

    with screen.progress("export", len(recorded), "trajectories") as bar:
        filmed = exports.blocks(recorded, film, bar.advance) if pixels else None
        if not pixels:  # nothing that takes time
            bar.advance(len(recorded))
        if kind == "hdf5":
            exports.write_hdf5(target, values, filmed, data.frame_shape, about)
        else:
            exports.write_npz(target, values, filmed, data.frame_shape, about)
    names = sorted([*values, *(["pixels"] if pixels else [])])
    screen.say(f"{len(recorded)} trajectories, {', '.join(names)}: {target}")
    return {
        "dataset": str(data.path),
        "split": split,
        "file": str(target),
        "format": kind,
        "rows": len(values["action"]),
        "columns": names,
        "size_bytes": target.stat().st_size,
    }


def open_dataset(path: Path | None, screen: Screen) -> Dataset:
    """Open the dataset at ``path``, or the newest in data/."""
    if path is None:
        path = newest()
        screen.say(f"newest dataset, {path}")
    return load_dataset(path)


def newest() -> Path:
    """Return the newest dataset in data/. Raises MissingInputError where there is none."""
    path = find_newest_dataset(ROOT)
    if path is None:
        raise MissingInputError(f"no dataset in {ROOT}/", hint="hjepa collect")
    return path


def summary(data: Dataset) -> Result:
    """Return what the manifest says."""
    return {
        "dataset": str(data.path),
        "plant": data.plant,
        "frames": data.frames,
        "sha256": data.digest,
        "size_bytes": sum(file.stat().st_size for file in data.path.glob("*") if file.is_file()),
        "splits": {
            name: {key: of[key] for key in ("trajectories", "steps")}
            | {"shards": len(of["shards"])}
            for name, of in data.splits.items()
        },
    }


def spread(split: Trajectories) -> list[list[float]]:
    """Return [least, greatest] of each state and of each applied force."""
    driven = split.applied_n.reshape(len(split), split.steps, -1)
    series = [*np.moveaxis(split.states, -1, 0), *np.moveaxis(driven, -1, 0)]
    return [[float(values.min()), float(values.max())] for values in series]


def labels(system: System) -> list[str]:
    """Return the names of what :func:`spread` is of: ``x [m]``, …, ``force [N]``.

    Of a recorded plant states have no units, and actions are in ± 1.
    """
    states = zip(system.state_names, system.state_units, strict=True)
    named = [f"{name} [{unit}]" if unit else name for name, unit in states]
    count = math.prod(system.action_shape)
    numbers = [""] if count == 1 else [f" {number}" for number in range(1, count + 1)]
    force = "action{}" if isinstance(system, Recorded) else "force{} [N]"
    return [*named, *(force.format(number) for number in numbers)]


def forces(applied_n: np.ndarray, system: System) -> str:
    """Return a step's forces as ``+1.5 N``, or ``+0.2 -0.1 N`` where there are several forces.

    Of a recorded plant they are its actions as they were recorded.
    """
    if isinstance(system, Recorded):
        return " ".join(f"{action:+.3g}" for action in applied_n.reshape(-1) * system.limits)
    return " ".join(f"{force:+.1f}" for force in applied_n.reshape(-1)) + " N"


def data_camera(data: Dataset) -> Camera:
    """Return the camera that a dataset's pictures are of."""
    return camera_of(data.kind, camera_in(data.settings), sensor_in(data.settings))


def _shown(value: object) -> object:
    """Return a list as text between commas."""
    return ", ".join(map(str, value)) or "none" if isinstance(value, list) else value


def chosen_format(out: Path | None, kind: str | None) -> str:
    """Return the format that was named, else that of the file's suffix, else npz.

    Raise UsageError where the suffix is of no format, or of another than the one that was named.
    """
    if out is None:
        return kind or "npz"
    meant = next((name for name, suffixes in FORMATS.items() if out.suffix in suffixes), None)
    if kind and meant and kind != meant:
        raise UsageError(
            f"--format {kind} contradicts the suffix of {out}",
            hint=f"--format {meant}, or --out {out.with_suffix(FORMATS[kind][0])}",
        )
    if not (kind or meant):
        raise UsageError(
            f"no export format has the suffix of {out}",
            hint="--format hdf5 or --format npz; or --out FILE.h5 or FILE.npz",
        )
    return kind or str(meant)


def held_bytes(data: Dataset, split: str) -> int:
    """Return what an export holds at once: the split twice while it is read, then its columns."""
    described = data.splits.get(split, {"trajectories": 0, "steps": 0})
    stored_bytes = math.prod(data.frame_shape) * (data.frames == "stored")
    return (
        described["trajectories"]
        * (described["steps"] + 1)
        * (4 * row_bytes(data) + 2 * stored_bytes)
    )


def row_bytes(data: Dataset) -> int:
    """Return what a row of an export has without its picture: states, and two times its forces."""
    system = data.kind
    return 4 * (len(system.state_names) + 2 * math.prod(system.action_shape))


def plan_export(
    path: Path | None, out: Path | None, split: str, kind: str | None, pixels: bool
) -> Plan:
    """Plan ``hjepa data export``; arguments as of :func:`export`."""
    kind = chosen_format(out, kind)
    data = load_dataset(path or newest())
    if split not in data.splits:
        data.split(split)  # says so
    described = data.splits[split]
    rows = described["trajectories"] * (described["steps"] + 1)
    frames = rows if pixels else 0
    work = [f"gather {rows} rows of split {split}"]
    if frames and data.frames == "rendered":
        work.append(f"render {frames} frames")
    target = out or Path(f"{data.path.name}-{split}{FORMATS[kind][0]}")
    return Plan(
        command="data export",
        reads=[f"dataset {data.path}"],
        work=work,
        writes=[f"{kind} file {target}"],
        writes_bytes=rows * row_bytes(data) + frames * COMPRESSED_FRAME_BYTES,
        seconds=1 + seconds_of({"rendered frames": frames, "exported frames": frames}),
        memory_bytes=held_bytes(data, split),
    )
