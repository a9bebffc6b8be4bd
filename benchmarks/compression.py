"""What compressing pictures costs: probes and force errors of a model on films of one quality each.

    python benchmarks/compression.py --checkpoint desktop-h4m2l1 --trajectories 40 --seed 0

The model's own plant is simulated, its pictures are coded as H.264 and decoded again, and the model
reads them. Linear probes are fitted to embeddings of half of the trajectories and tested on the
others; the NMAE is that of ``hjepa`` alone after one packet on clean rollouts, 95 % bootstrap
interval over rollouts. Motion of less than a pixel, where velocity is, goes first.
"""

import argparse
import io

import av
import numpy as np
import torch

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core import statistics
from hjepa_cli.core.control.drivers import build_driver
from hjepa_cli.core.datasets.trajectories import generate
from hjepa_cli.core.evaluation.control_errors import control_errors
from hjepa_cli.core.evaluation.offline import embedded
from hjepa_cli.core.networks import health
from hjepa_cli.core.networks.model import Model
from hjepa_cli.core.plants.frames import frames_of
from hjepa_cli.storage.zoo import resolve_model

QUALITIES = {"lossless": None, "H.264, crf 10": 10, "H.264, crf 18": 18, "H.264, crf 23": 23}


def coded(frames: np.ndarray, crf: int | None) -> np.ndarray:
    """Return frames [N, T, H, W, 3] after a film of each trajectory."""
    if crf is None:
        return frames
    found = []
    for pictures in frames:
        buffer = io.BytesIO()
        with av.open(buffer, "w", format="mp4") as film:
            stream = film.add_stream("libx264", rate=50, options={"crf": str(crf)})
            stream.height, stream.width = pictures.shape[1:3]
            stream.pix_fmt = "yuv420p"
            for picture in pictures:
                film.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            film.mux(stream.encode())
        buffer.seek(0)
        with av.open(buffer) as film:
            found.append([one.to_ndarray(format="rgb24") for one in film.decode(video=0)])
    return np.array(found, np.uint8)


def main() -> None:
    """Print a row for each quality."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--checkpoint", default="desktop-h4m2l1")
    parser.add_argument("--trajectories", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    model = Model.load(resolve_model(given.checkpoint), "cpu")
    settings = load_settings(None, None, {"plant": model.plant_name, "seed": given.seed})
    train = generate(settings, "train", range(given.trajectories))
    clean = generate(settings, "clean", range(given.trajectories))
    driver = build_driver("hjepa", settings, model)
    half, names = given.trajectories // 2, model.plant.state_names
    print("quality", *(f"R² {name}" for name in names), "NMAE 1-100 (95 % CI)", sep=" | ")
    for quality, crf in QUALITIES.items():
        frames = coded(frames_of(model.camera, train.states, 20), crf)
        z, states = embedded(model, frames), torch.from_numpy(train.states[:, 1:])
        parts = (values[part].flatten(0, 1) for part in (slice(half), slice(half, None))
                 for values in (z, states))  # fmt: skip
        probes = health.probe_r2(*parts, names)
        errors = control_errors(
            driver,
            coded(frames_of(model.camera, clean.states, 20), crf),
            clean.teacher_n.astype(float),
            model.force_limit_n,
            settings.protocol.horizon,
        )[:, 1:].mean(axis=1)
        weights = statistics.bootstrap_weights(len(errors), 1000, given.seed)
        low, high = statistics.mean_interval(errors, weights)
        row = [f"{value:.3f}" for value in probes.values()]
        print(quality, *row, f"{errors.mean():.4f} ({low:.4f}–{high:.4f})", sep=" | ", flush=True)


if __name__ == "__main__":
    main()
