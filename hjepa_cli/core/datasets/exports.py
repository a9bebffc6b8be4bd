"""Other programs get datasets as HDF5 in stable-worldmodel's layout, or as NPZ with its columns.

One row per frame, trajectory after trajectory. A trajectory of T steps gives T + 1 rows: its first
is the frame before k = 0, which moves on without force. So no frame is lost, and row j of a
trajectory holds what was seen and the action that led from there to row j + 1:

- ``pixels`` uint8 [rows, H, W, C], the camera's frames, 64 × 128 RGB ones unless set otherwise;
- ``state`` float32 [rows, S], of a cart-pole x (m), x_dot (m/s), theta (rad), theta_dot (rad/s);
  none where no states were recorded;
- ``action`` float32 [rows, m], the m applied forces (a cart-pole's one) ÷ the limit, in [-1, 1];
- ``teacher_action`` float32 [rows, m], what the teacher would do there, on the same scale;
- ``ep_len`` int32 and ``ep_offset`` int64 [trajectories], rows of each and its first row.
"""

import io
import json
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hjepa_cli.core.datasets.dataset import Trajectories
from hjepa_cli.errors import MissingInputError
from hjepa_cli.storage.files import replacing, write_bytes

TOGETHER = 20  # trajectories rendered and written at a time

Frames = Callable[[Trajectories], np.ndarray]
"""It renders trajectories: uint8 [N, T + 1, H, W, 3]."""


def columns(
    split: Trajectories, first_teacher_n: np.ndarray, force_limit_n: float
) -> dict[str, np.ndarray]:
    """Return all columns but ``pixels``; ``first_teacher_n`` [N, *A] is from before k = 0."""
    count, rows = split.states.shape[:2]

    def actions(first_n: np.ndarray, forces_n: np.ndarray) -> np.ndarray:
        joined_n = np.concatenate([first_n[:, None], forces_n], axis=1)
        return (joined_n / force_limit_n).astype(np.float32).reshape(count * rows, -1)

    states = split.states.reshape(count * rows, split.states.shape[-1])
    return {
        **({"state": states} if states.shape[1] else {}),
        "action": actions(np.zeros_like(first_teacher_n), split.applied_n),
        "teacher_action": actions(first_teacher_n, split.teacher_n),
        "ep_len": np.full(count, rows, np.int32),
        "ep_offset": np.arange(count, dtype=np.int64) * rows,
    }


def write_hdf5(
    path: Path,
    values: dict[str, np.ndarray],
    pixels: Iterator[np.ndarray] | None,
    frame_shape: tuple[int, ...],
    about: dict[str, Any],
) -> None:
    """Write the columns as one HDF5 file, atomically; equal data give equal bytes.

    ``pixels`` are blocks of frames [n, H, W, C] in row order, or ``None`` to leave the column out;
    ``frame_shape`` is (H, W, C), ``about`` plain JSON data for the attribute ``hjepa``.

    Raises:
        MissingInputError: h5py is not installed.
        StorageError: the disk refused.
    """
    try:
        import h5py
    except ModuleNotFoundError:
        raise MissingInputError(
            "HDF5 needs h5py, which is not installed",
            hint='pip install "hjepa[hdf5]", or --format npz',
        ) from None
    buffer = io.BytesIO()
    # Later layouts are read by the newest libraries alone; peers append, which needs no last row.
    with h5py.File(buffer, "w", libver=("v110", "v110")) as file:
        for name, array in values.items():
            file.create_dataset(name, data=array, chunks=True, maxshape=(None, *array.shape[1:]))
        if pixels is not None:
            shape = (len(values["action"]), *frame_shape)
            # A frame per chunk, as peers read single rows; gzip makes it 50 times smaller.
            column = file.create_dataset(
                "pixels", shape, np.uint8, maxshape=(None, *frame_shape),
                chunks=(1, *frame_shape), compression=1,
            )  # fmt: skip
            start = 0
            for block in pixels:
                column[start : start + len(block)] = block
                start += len(block)
        file.attrs["hjepa"] = json.dumps(about, sort_keys=True)
    write_bytes(path, buffer.getvalue())


def write_npz(
    path: Path,
    values: dict[str, np.ndarray],
    pixels: Iterator[np.ndarray] | None,
    frame_shape: tuple[int, ...],
    about: dict[str, Any],
) -> None:
    """Write the columns as one compressed NPZ file, atomically; equal data give equal bytes."""
    arrays = {"hjepa": np.array(json.dumps(about, sort_keys=True)), **values}
    with replacing(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:

        def put(name: str, blocks: Iterator[np.ndarray], shape: tuple[int, ...]) -> None:
            """Add an array block by block: frames are many times larger than the file."""
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                for number, block in enumerate(blocks):
                    if number == 0:
                        described = np.lib.format.header_data_from_array_1_0(block)
                        np.lib.format.write_array_header_1_0(entry, {**described, "shape": shape})
                    entry.write(np.ascontiguousarray(block).data)

        for name, array in arrays.items():
            put(name, iter([array]), array.shape)
        if pixels is not None:
            put("pixels", pixels, (len(next(iter(values.values()))), *frame_shape))


def blocks(split: Trajectories, frames: Frames, tick: Callable[[int], None]) -> Iterator[Any]:
    """Yield frames of a split in row order, some trajectories at a time: [n, H, W, 3]."""
    for start in range(0, len(split), TOGETHER):
        part = split[start : start + TOGETHER]
        images = frames(part)
        yield images.reshape(-1, *images.shape[-3:])
        tick(len(part))
