"""Small recordings: a bright square that two actions push around, in every format."""

import csv
import io
import json

import numpy as np

H, W = 24, 40


def make(episodes=5, steps=30, seed=0, lag=0):
    """Return frames [N, T, H, W, 3], actions [N, T, 2] and states [N, T, 4].

    Action row j leads from frame j to frame j + 1; with a ``lag`` it is found so many rows later.
    """
    random = np.random.default_rng(seed)
    frames = np.zeros((episodes, steps, H, W, 3), np.uint8)
    actions = np.zeros((episodes, steps, 2))
    states = np.zeros((episodes, steps, 4))
    for n in range(episodes):
        place, speed = random.uniform(8, 16, 2) * [1, 1.8], np.zeros(2)
        for k in range(steps):
            frames[n, k] = square(place)
            states[n, k] = [*place, *speed]
            actions[n, k] = random.uniform(-1, 1, 2)
            speed = 0.9 * speed + 0.6 * actions[n, k]
            place = place + speed
            hit = (place < 4) | (place > np.array([H, W]) - 4)
            speed[hit] *= -1
            place = place.clip(4, np.array([H, W]) - 4.0)
    return frames, np.roll(actions, lag, axis=1), states


def square(place):
    """An anti-aliased square of 6 × 6 pixels around a place (row, column)."""
    rows, columns = (
        (np.minimum(np.arange(n) + 1, c + 3) - np.maximum(np.arange(n), c - 3)).clip(0, 1)
        for n, c in zip((H, W), place, strict=True)
    )
    return np.rint(200 * rows[:, None, None] * columns[None, :, None] * np.ones(3)).astype(np.uint8)


def folder(root, frames, actions, states=None, *, suffix="png"):
    """Write a folder of pictures with one CSV for all episodes."""
    from PIL import Image

    root.mkdir()
    header = ["episode", "frame", "action_x", "action_y"]
    header += [] if states is None else [f"state_{i}" for i in range(states.shape[-1])]
    with open(root / "rows.csv", "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(header)
        for n, episode in enumerate(frames):
            for k, picture in enumerate(episode):
                name = f"{n}_{k:04d}.{suffix}"
                Image.fromarray(picture).save(root / name)
                known = [] if states is None else map(float, states[n, k])
                table.writerow([n, name, *map(float, actions[n, k]), *known])
    return root


def film(root, frames, actions, *, codec="libx264rgb", rate=20, options=None, suffix="mp4"):
    """Write each episode as a film with a CSV beside it."""
    import av

    root.mkdir()
    for n, episode in enumerate(frames):
        path = root / f"run_{n}.{suffix}"
        write_film(path, episode, codec=codec, rate=rate, options=options)
        with open(path.with_suffix(".csv"), "w", newline="") as file:
            table = csv.writer(file)
            table.writerow(["action_x", "action_y"])
            table.writerows(actions[n].tolist())
    assert av
    return root


def write_film(path, pictures, *, codec="libx264rgb", rate=20, options=None):
    """Write one film, by default without losses."""
    import av

    pixels = "rgb24" if codec in ("libx264rgb", "ffv1") else "yuv420p"
    if codec == "ffv1":
        pixels = "bgr0"
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, options=options or {"qp": "0"})
        stream.height, stream.width = pictures.shape[1:3]
        stream.pix_fmt = pixels
        for picture in pictures:
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def lerobot(root, frames, actions, states, *, version):
    """Write a LeRobotDataset of version 2 or 3 with films."""
    import pyarrow
    import pyarrow.parquet as parquet

    count, steps = actions.shape[:2]
    (root / "meta").mkdir(parents=True)
    key = "observation.images.top"
    info = {
        "codebase_version": f"v{version}.1" if version == 2 else "v3.0",
        "fps": 20,
        "total_episodes": count,
        "chunks_size": 1000,
        "features": {
            key: {"dtype": "video", "shape": [H, W, 3]},
            "action": {"dtype": "float32", "shape": [2]},
            "observation.state": {"dtype": "float32", "shape": [4], "names": list("abcd")},
        },
    }
    episode = "{episode_index:06d}"
    if version == 2:
        info["data_path"] = f"data/chunk-{{episode_chunk:03d}}/episode_{episode}.parquet"
        info["video_path"] = (
            f"videos/chunk-{{episode_chunk:03d}}/{{video_key}}/episode_{episode}.mp4"
        )
    else:
        info["data_path"] = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
        info["video_path"] = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    (root / "meta" / "info.json").write_text(json.dumps(info))

    def rows(numbers):
        number = np.repeat(numbers, steps)
        return pyarrow.table(
            {
                "episode_index": number,
                "frame_index": np.tile(np.arange(steps), len(numbers)),
                "timestamp": np.tile(np.arange(steps) / 20, len(numbers)).astype(np.float32),
                "action": actions[numbers].reshape(-1, 2).astype(np.float32).tolist(),
                "observation.state": states[numbers].reshape(-1, 4).astype(np.float32).tolist(),
            }
        )

    def put(table, place):
        path = root / place
        path.parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(table, path)

    place = {"episode_chunk": 0, "chunk_index": 0, "file_index": 0, "video_key": key}
    groups = [[n] for n in range(count)] if version == 2 else [list(range(count))]
    for numbers in groups:
        at = {**place, "episode_index": numbers[0]}
        put(rows(numbers), info["data_path"].format(**at))
        path = root / info["video_path"].format(**at)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_film(path, np.concatenate([frames[n] for n in numbers]))
    if version == 3:
        said = {
            "episode_index": list(range(count)),
            "data/chunk_index": [0] * count,
            "data/file_index": [0] * count,
            f"videos/{key}/chunk_index": [0] * count,
            f"videos/{key}/file_index": [0] * count,
            f"videos/{key}/from_timestamp": [n * steps / 20 for n in range(count)],
            f"videos/{key}/to_timestamp": [(n + 1) * steps / 20 for n in range(count)],
        }
        put(pyarrow.table(said), "meta/episodes/chunk-000/file-000.parquet")
    return root


def minari(root, frames, actions, *, encoded=False):
    """Write the HDF5 of a dataset of Minari, which keeps large pictures as files in a column."""
    import h5py
    from PIL import Image

    def file_of(picture):
        buffer = io.BytesIO()
        Image.fromarray(picture).save(buffer, "PNG")
        return np.frombuffer(buffer.getvalue(), np.uint8)

    (root / "data").mkdir(parents=True)
    space = {"type": "Box", "low": [-1.0, -1.0], "high": [1.0, 1.0]}
    (root / "data" / "metadata.json").write_text(json.dumps({"action_space": json.dumps(space)}))
    with h5py.File(root / "data" / "main_data.hdf5", "w") as file:
        for n, episode in enumerate(frames):
            group = file.create_group(f"episode_{n}")
            if encoded:
                kind = h5py.vlen_dtype(np.uint8)
                column = group.create_dataset("observations/pixels", len(episode), kind)
                for row, picture in enumerate(episode):
                    column[row] = file_of(picture)
            else:
                group["observations/pixels"] = episode
            group["actions"] = actions[n][: len(episode) - 1]
    return root
