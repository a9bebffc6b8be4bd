"""One training step of the encoder, timed side by side with two loops doing the same learning.

    python benchmarks/train_step.py [--rounds 5]

- ``hjepa``: draw windows from uint8 frames, JEPA losses, optimiser step, EMA update, as shipped.
- ``bare``: the same networks, losses and updates on one preloaded batch: what the hardware gives.
- ``shared``: a plain loop that also encodes every frame once: fp32, NCHW, torch DataLoader.
- ``plain``: the usual loop: items are (start frame, frames of its rollout), so that a frame is
  encoded once for every rollout it appears in: fp32, NCHW, torch DataLoader.

Every loop predicts the same number of embeddings from the same number of starts per step; speeds
are predicted embeddings per second, taken in turn so that a drifting machine moves all alike.
"""

import argparse
import statistics
import time
from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from hjepa_cli.core.batches import FrameWindows
from hjepa_cli.core.camera import Camera
from hjepa_cli.core.ema import EmaTarget
from hjepa_cli.core.encoder import CENTRE_OFFSET, Encoder, normalise
from hjepa_cli.core.jepa import Jepa
from hjepa_cli.core.losses import InverseDynamics, cosine_loss
from hjepa_cli.core.predictors import Predictor
from hjepa_cli.core.training import Optimiser, autocast
from hjepa_cli.core.trajectories import generate
from hjepa_cli.settings import Settings, load_settings

TRAJECTORIES = 40
CPU = torch.device("cpu")


class PlainEncoder(nn.Module):
    """The same network on ready float32 NCHW input."""

    def __init__(self, encoder: Encoder) -> None:
        super().__init__()
        self.encoder = encoder.to(memory_format=torch.contiguous_format)

    def forward(self, x: Tensor) -> Tensor:
        net = self.encoder
        x = torch.relu(net.stem_norm(net.stem(x)))
        x = torch.relu(net.squeeze(net.stages(x)))
        z = net.head(x.flatten(1))
        return normalise(z if net.centre is None else net.centre(z) + CENTRE_OFFSET)


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


def plain_step(settings: Settings, loader: Iterator[tuple[Tensor, Tensor]], state: "Plain") -> int:
    """One step of a loop on windows in which every item is one rollout; returns predictions."""
    images, actions = next(loader)
    count, window = images.shape[:2]
    flat = images.flatten(0, 1)
    z = state.encoder(flat).unflatten(0, (count, window))
    with torch.no_grad():
        targets = state.target.module(flat).unflatten(0, (count, window))
    now, losses = z[:, 0], []
    for stride in range(window - 1):
        now = state.predictor(now, actions[:, stride])
        losses.append(cosine_loss(now, targets[:, stride + 1]))
    inverse = state.inverse.loss(
        z[:, :-1].flatten(0, 1), z[:, 1:].flatten(0, 1), actions.mean(-1).flatten()
    )
    loss = torch.stack(losses).mean() + inverse
    state.optimiser.zero_grad()
    loss.backward()
    state.optimiser.step()
    state.target.update(state.encoder)
    return count * (window - 1)


class Plain:
    """Networks and optimiser of the plain loop."""

    def __init__(self, settings: Settings) -> None:
        options = settings.encoder
        self.encoder = PlainEncoder(Encoder(options.embedding, "difference", options.centre))
        self.target = EmaTarget(self.encoder, options.ema_decay)
        self.predictor = Predictor(options.embedding, options.hidden, options.h)
        self.inverse = InverseDynamics(options.embedding)
        modules = (self.encoder, self.predictor, self.inverse)
        self.optimiser = torch.optim.AdamW([p for m in modules for p in m.parameters()])


def batches(data: Windows, size: int) -> Iterator[tuple[Tensor, Tensor]]:
    while True:
        yield from DataLoader(data, batch_size=size, shuffle=True, drop_last=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    torch.manual_seed(0)
    settings = load_settings(flags={"collect.trajectories": TRAJECTORIES})
    options = settings.encoder
    data = generate(settings, "train")
    images = Camera(settings.plant).render(data.states.reshape(-1, 4))
    frames = torch.from_numpy(images).unflatten(0, data.states.shape[:2])
    actions = torch.from_numpy(data.applied_n / 20.0)

    encoder = Encoder(options.embedding, options.frame_input, options.centre)
    jepa = Jepa(
        encoder,
        Predictor(options.embedding, options.hidden, options.h),
        ema_decay=options.ema_decay,
        inverse_dynamics=options.inverse_dynamics,
        rollout_strides=options.rollout_steps // options.h,
        device=CPU,
    )
    optimiser = Optimiser(
        jepa.parameters(),
        name="adamw",
        schedule="constant",
        steps=1,
        learning_rate=1e-4,
        weight_decay=1e-2,
        gradient_clip=1.0,
    )
    windows = FrameWindows(
        frames, actions, window_frames=options.batch_frames, stride=options.h, mirror=True
    )
    stream = np.random.default_rng(0)
    preloaded = windows.draw(options.batch_trajectories, stream)
    strides, horizon = windows.window_frames - 1, options.rollout_steps // options.h
    predictions = options.batch_trajectories * sum(strides - step for step in range(horizon))

    def ours(batch_of: Callable[[], object]) -> int:
        with autocast(CPU, "auto"):
            terms = jepa.losses(batch_of())
        optimiser.step(jepa.total(terms), 0)
        jepa.update_target()
        return predictions

    # A shared-encoding window of F frames gives F − 1 starts; a plain item gives one.
    plain_window = round(predictions / (options.batch_trajectories * strides)) + 1
    plain_items = batches(Windows(frames, actions, plain_window, options.h), 20)
    shared_items = batches(Windows(frames, actions, windows.window_frames, options.h), 10)
    plain, shared = Plain(settings), Plain(settings)

    def shared_step() -> int:
        plain_step(settings, shared_items, shared)
        return predictions

    loops: dict[str, Callable[[], int]] = {
        "hjepa": lambda: ours(lambda: windows.draw(options.batch_trajectories, stream)),
        "bare": lambda: ours(lambda: preloaded),
        "shared": shared_step,
        "plain": lambda: plain_step(settings, plain_items, plain),
    }
    speeds: dict[str, list[float]] = {name: [] for name in loops}
    for turn in range(rounds + 1):
        for name, step in loops.items():
            started = time.perf_counter()
            done = step()
            if turn:  # the first turn warms up
                speeds[name].append(done / (time.perf_counter() - started))
    print(f"predicted embeddings per second, median [min, max] of {rounds} rounds")
    for name, values in speeds.items():
        median = statistics.median(values)
        ratio = statistics.median(o / v for o, v in zip(speeds["hjepa"], values, strict=True))
        spread = f"[{min(values):.0f}, {max(values):.0f}]"
        print(f"{name:8s} {median:9.0f} {spread:18s} hjepa ÷ it: {ratio:.2f}")


if __name__ == "__main__":
    main()
