"""One training step of the encoder, timed side by side with other loops on the same networks.

    python benchmarks/train_step.py [--rounds 5]

- ``hjepa``: draw windows from uint8 frames, JEPA losses, optimiser step, EMA update, as shipped.
- ``bare``: the same on one preloaded batch; the difference is what drawing windows costs.
- ``shared``: the same objective on the same number of windows of the same size, written plainly:
  float32 NCHW pixels standardised one by one in a DataLoader's dataset, no autocast.
- ``plain``: as ``shared``, but an item is one start with the frames of its own rollout, the usual
  way to feed rollouts. A rollout is as long as those of ``hjepa`` on average.

A window of F frames serves ``hjepa``, ``bare`` and ``shared`` as F − 1 starts at once: each frame
is encoded once (and once by the target) and every rollout it belongs to uses that embedding.
``plain`` encodes a frame again for every rollout. Two speeds are therefore reported: predicted
embeddings per second, the training signal that arrives, and frames through the context encoder per
second, the work that is done. The first is the second times predictions per frame, so ``hjepa ÷
plain`` is the product of two ratios, both printed: of predictions per frame ("sharing", the same on
every machine) and of frames per second ("speed": precision, memory layout, drawing of items, which
depends on the machine). DataLoaders run in this process; loops take turns, so that a drifting
machine moves all alike.

Exits with 1 if hjepa ÷ plain < 5 or hjepa ÷ bare < 0.9 in predicted embeddings per second.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.data import DataLoader, Dataset

from hjepa_cli.compute.device import autocast
from hjepa_cli.config.schema import Settings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.datasets.trajectories import generate
from hjepa_cli.core.networks.encoder import STEM_PX, Encoder, normalise
from hjepa_cli.core.networks.model import build_modules
from hjepa_cli.core.networks.predictors import Predictor
from hjepa_cli.core.networks.symmetry import flatten_twins
from hjepa_cli.core.plants.named import Camera
from hjepa_cli.core.training.batches import FrameWindows
from hjepa_cli.core.training.jepa import EmaTarget, Jepa
from hjepa_cli.core.training.losses import InverseDynamics, rollout_loss
from hjepa_cli.core.training.optimiser import Optimiser
from hjepa_cli.stages.train_encoder import describe_architecture

FLAGS = {  # pairs of frames, as the usual loops draw them
    "collect.trajectories": 40,
    "control.gains_n": [],
    "encoder.frames": 2,
    "encoder.photometric": "none",
}
PLAIN_ITEMS = 20  # about as many frames per step as the other loops encode
LEAST_RATIOS = {"plain": 5.0, "bare": 0.9}
CPU = torch.device("cpu")


class Work(NamedTuple):
    """What one step of a loop does."""

    predictions: int
    frames: int


class Loop(NamedTuple):
    """One way to train, and how much of it a step is."""

    step: Callable[[], None]
    work: Work


class PlainEncoder(nn.Module):
    """The same network on ready float32 NCHW input."""

    def __init__(self, encoder: Encoder) -> None:
        super().__init__()
        self.encoder = encoder.to(memory_format=torch.contiguous_format)

    def forward(self, x: Tensor) -> Tensor:
        net = self.encoder
        x = torch.relu(net.stem_norm(F.conv2d(x, *net._stem(), stride=STEM_PX)))
        x = torch.relu(net.squeeze(net.stages(x)))
        z = net.head(flatten_twins(x) if net.symmetric else x.flatten(1))
        return normalise(z if net.centre is None else net.centre(z) + net.offset)


class Windows(Dataset[tuple[Tensor, Tensor]]):
    """Float windows [F, 6, H, W] and actions [F − 1, h]; one item per trajectory and offset."""

    def __init__(self, frames: Tensor, actions: Tensor, window: int, stride: int) -> None:
        self.frames, self.actions, self.window, self.stride = frames, actions, window, stride
        self.offsets = actions.shape[1] - (window - 1) * stride
        sample = frames[:, ::10].float()
        self.mean, self.std = sample.mean((0, 1, 2, 3)), sample.std((0, 1, 2, 3))

    def __len__(self) -> int:
        return len(self.frames) * self.offsets

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor]:
        row, offset = divmod(index, self.offsets)
        k = offset + self.stride * torch.arange(self.window)
        previous, current = self.frames[row, k].float(), self.frames[row, k + 1].float()
        pair = torch.cat([(current - self.mean) / self.std, (current - previous) / self.std], -1)
        actions = [self.actions[row, step : step + self.stride] for step in k[:-1].tolist()]
        return pair.permute(0, 3, 1, 2).contiguous(), torch.stack(actions)


class PlainTraining:
    """A training loop of float32 networks over a DataLoader.

    Args:
        data: what an item is.
        size: items per step.
        starts: frames of an item that rollouts start from [S].
        horizon: strides to roll out, where the item does not end before.
    """

    def __init__(
        self, settings: Settings, data: Windows, size: int, starts: Tensor, horizon: int
    ) -> None:
        options = settings.encoder
        self.batches, self.starts, self.horizon = batches(data, size), starts, horizon
        self.weight = options.inverse_dynamics
        encoder, self.predictor, mirror = networks(settings)
        self.encoder = PlainEncoder(encoder)
        self.target = EmaTarget(self.encoder, options.ema_decay)
        self.inverse = InverseDynamics(options.embedding, mirror=mirror)
        modules = (self.encoder, self.predictor, self.inverse)
        self.optimiser = optimiser(p for module in modules for p in module.parameters())

    def step(self) -> None:
        images, actions = next(self.batches)
        shape, flat = images.shape[:2], images.flatten(0, 1)
        z = self.encoder(flat).unflatten(0, shape)
        with torch.no_grad():
            targets = self.target.module(flat).unflatten(0, shape)
        prediction = rollout_loss(self.predictor, z, targets, actions, self.starts, self.horizon)
        inverse = self.inverse.loss(
            z[:, :-1].flatten(0, 1), z[:, 1:].flatten(0, 1), actions.mean(-1).flatten()
        )
        self.optimiser.step(prediction + self.weight * inverse, 0)
        self.target.update(self.encoder)


def networks(settings: Settings) -> tuple[Encoder, Predictor, tuple[float, ...] | None]:
    """What ``train-encoder`` trains, and what a mirror does to the force."""
    modules = build_modules(describe_architecture(settings))
    encoder, predictor = modules["encoder"], modules["high"]
    assert isinstance(encoder, Encoder) and isinstance(predictor, Predictor)
    return encoder, predictor, (-1.0,) if settings.encoder.mirror == "exact" else None


def optimiser(parameters: Iterator[nn.Parameter]) -> Optimiser:
    return Optimiser(
        parameters,
        name="adamw",
        schedule="constant",
        steps=1,
        learning_rate=1e-4,
        weight_decay=1e-2,
        gradient_clip=1.0,
    )


def batches(data: Windows, size: int) -> Iterator[tuple[Tensor, Tensor]]:
    while True:
        yield from DataLoader(data, batch_size=size, shuffle=True, drop_last=True)


def build_loops(settings: Settings) -> dict[str, Loop]:
    options = settings.encoder
    data = generate(settings, "train")
    images = Camera(settings.plant).render(data.states.reshape(-1, 4))
    frames = torch.from_numpy(images).unflatten(0, data.states.shape[:2])
    actions = torch.from_numpy(data.applied_n / 20.0)

    count, horizon = options.batch_trajectories, options.rollout_steps // options.h
    encoder, predictor, mirror = networks(settings)
    jepa = Jepa(
        encoder,
        predictor,
        ema_decay=options.ema_decay,
        inverse_dynamics=options.inverse_dynamics,
        rollout_strides=horizon,
        device=CPU,
        mirror=mirror,
    )
    update = optimiser(jepa.parameters())
    windows = FrameWindows(
        frames,
        actions,
        window_frames=options.batch_frames,
        stride=options.h,
        mirror=options.mirror == "augment",
        shift_px=options.shift_px,
    )
    stream = np.random.default_rng(0)
    preloaded = windows.draw(count, stream)

    def ours(draw: bool) -> None:
        batch = windows.draw(count, stream) if draw else preloaded
        with autocast(CPU, options.precision):
            terms = jepa.losses(batch)
        update.step(jepa.total(terms), 0)
        jepa.after_step()

    window = windows.window_frames
    starts = torch.arange(window - 1)
    lengths = torch.clamp(window - 1 - starts, max=horizon)  # rollouts end with their window
    same = Work(count * int(lengths.sum()), count * window)
    strides = round(float(lengths.float().mean()))
    shared = PlainTraining(
        settings, Windows(frames, actions, window, options.h), count, starts, horizon
    )
    plain = PlainTraining(
        settings,
        Windows(frames, actions, strides + 1, options.h),
        PLAIN_ITEMS,
        torch.tensor([0]),
        strides,
    )
    return {
        "hjepa": Loop(lambda: ours(True), same),
        "bare": Loop(lambda: ours(False), same),
        "shared": Loop(shared.step, same),
        "plain": Loop(plain.step, Work(PLAIN_ITEMS * strides, PLAIN_ITEMS * (strides + 1))),
    }


def time_in_turn(loops: dict[str, Loop], rounds: int) -> dict[str, list[float]]:
    """Seconds of each step; a first round, not reported, warms up."""
    took_s: dict[str, list[float]] = {name: [] for name in loops}
    for turn in range(rounds + 1):
        for name, loop in loops.items():
            started = time.perf_counter()
            loop.step()
            if turn:
                took_s[name].append(time.perf_counter() - started)
    return took_s


def shortfalls(ratios: dict[str, float]) -> list[str]:
    """What is slower than promised, given hjepa ÷ each loop."""
    return [
        f"hjepa ÷ {name} is {ratios[name]:.2f}, less than {least:g}"
        for name, least in LEAST_RATIOS.items()
        if ratios[name] < least
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    torch.manual_seed(0)
    loops = build_loops(load_settings(flags=FLAGS))
    took_s = time_in_turn(loops, rounds)
    print(f"{torch.get_num_threads()} threads; medians of {rounds} rounds, [min, max]")
    print("          predicted embeddings/s       encoded frames/s   hjepa ÷ it = sharing x speed")
    ours, ratios = loops["hjepa"].work, {}
    for name, (_, work) in loops.items():
        predicted, encoded = ([done / s for s in took_s[name]] for done in work)
        turns = zip(took_s[name], took_s["hjepa"], strict=True)
        faster = statistics.median(its_s / ours_s for its_s, ours_s in turns)
        ratios[name] = faster * ours.predictions / work.predictions
        sharing = (ours.predictions / ours.frames) / (work.predictions / work.frames)
        spread = f"[{min(predicted):.0f}, {max(predicted):.0f}]"
        print(
            f"{name:8s} {statistics.median(predicted):8.0f} {spread:20s}"
            f" {statistics.median(encoded):14.0f}   {ratios[name]:10.2f} = "
            f"{sharing:7.2f} x {ratios[name] / sharing:5.2f}"
        )
    missed = shortfalls(ratios)
    for line in missed:
        print(line, file=sys.stderr)
    sys.exit(1 if missed else 0)


if __name__ == "__main__":
    main()
