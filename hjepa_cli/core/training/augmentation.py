"""Pictures for training are made worse, each in its own way; labels and targets stay clean ones.

What a network is asked for does not change with the light, the noise or a thing in a corner, so
only what it looks at is augmented (as in SVEA and SADA, and unlike training pictures that vary for
targets too, from which a world model would have to predict the light). The frames of one input
share what is slow: light, colour, rotation, height, blur, a rectangle. Noise, jitter and flicker
are drawn for each: they are what drowns a velocity.

Left out, so that there is something to test on: JPEG, shifts to a side, lenses, stains, vignettes,
dead pixels, bars and hidden edges, contrast and brightness.
"""

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from hjepa_cli.config.schema import AugmentSettings

MOST_SEED = 2**62
BLUR_REACH = 2.5  # standard deviations that a blur is cut off at
FARTHEST_BLUR_PX = 8.0
SHIFTED_DOWN = 0.15  # share of pictures; with more, turned ones are not learned (docs/LOG.md)
NOISE_INPUTS = 4  # whose noise is drawn for a window
NUMBERS = 40  # uniform ones that an input takes at most, besides noise and jitter …
OF_RECTANGLE = 6  # … and those of the rectangles after the first


class Augmentation:
    """It makes windows of inputs worse, by the settings of ``[augment]``.

    A window's pictures follow from its seed alone: not from how many are made worse together.
    """

    def __init__(self, settings: AugmentSettings) -> None:
        self._of = settings

    def draw(self, count: int, generator: np.random.Generator) -> list[int] | None:
        """Draw seeds for windows; ``None``, and no draw, where it is off."""
        on = self._of.strength > 0
        return generator.integers(MOST_SEED, size=count).tolist() if on else None

    def __call__(self, frames: Tensor, seeds: list[int]) -> Tensor:
        """Return worse frames uint8 [B · F, κ, H, W, C], those of B windows one after the other."""
        worse = torch.empty_like(frames)
        windows = (of.reshape(len(seeds), -1, *frames.shape[1:]) for of in (frames, worse))
        with torch.no_grad(), torch.autocast(frames.device.type, enabled=False):
            for before, after, seed in zip(*windows, seeds, strict=True):
                self._window(before, after, seed)
        return worse

    def _window(self, before: Tensor, after: Tensor, seed: int) -> None:
        """Make inputs [F, κ, H, W, C] worse, one by one: the work stays in the cache."""
        random = torch.Generator().manual_seed(seed)
        count = NUMBERS + OF_RECTANGLE * (self._of.rectangles - 1)
        numbers = torch.rand(len(before), count, generator=random).tolist()
        jitter_px = torch.randn(*before.shape[:2], 2, generator=random)
        size = before[0].numel()
        # Each input's noise is cut from one strip at a place of its own: drawing numbers takes most
        # of the time.
        on_device = random
        if before.device.type != "cpu":
            on_device = torch.Generator(before.device).manual_seed(seed)
        strip = torch.randn(NOISE_INPUTS * size, generator=on_device, device=before.device)
        for clean, worse, drawn, moves_px in zip(before, after, numbers, jitter_px, strict=True):
            draws = _Draws(self._of, drawn)
            if draws.uniform() < self._of.clean:
                worse.copy_(clean)
                continue
            pictures = self._moved(clean.float(), moves_px, draws)
            for _ in range(self._of.rectangles):
                self._cover(pictures, draws)
            pictures = self._blurred(pictures, draws)
            self._light(pictures, draws)
            start = int(draws.uniform() * (len(strip) - size))
            self._add_noise(pictures, strip[start : start + size].view(pictures.shape), draws)
            worse.copy_(pictures.round_().clamp_(0, 255))

    def _moved(self, pictures: Tensor, moves_px: Tensor, draws: "_Draws") -> Tensor:
        """Turn pictures [κ, H, W, C] around their middle, and move them up or down.

        Each moves by parts of a pixel besides.
        """
        turned = draws.chosen(self._of.rotation_share)
        angle = math.radians(draws.both_ways(self._of.rotation_deg, turned))
        jitter_px = draws.most(self._of.jitter_px) * draws.chosen()
        down_px = 0.0
        if self._of.shift_down_px:  # no number is drawn for what is off
            down_px = draws.both_ways(self._of.shift_down_px, draws.chosen(SHIFTED_DOWN))
        if not (angle or jitter_px or down_px):
            return pictures
        height, width = pictures.shape[1:3]
        # Places count from the middle of the picture, which is 2 wide and 2 high for grid_sample.
        rows, columns = (torch.arange(side) - (side - 1) / 2 for side in (height, width))
        sin, cos = math.sin(angle), math.cos(angle)
        right = cos * columns[None] - sin * rows[:, None]
        down = sin * columns[None] + cos * rows[:, None]
        places = torch.stack([right * (2 / width), down * (2 / height)], dim=-1)
        moves = jitter_px * moves_px - torch.tensor([0.0, down_px])
        moves = moves * torch.tensor([2 / width, 2 / height])
        grid = (places + moves[:, None, None]).to(pictures.device)
        seen = pictures.permute(0, 3, 1, 2)
        warped = F.grid_sample(seen, grid, padding_mode="border", align_corners=False)
        return warped.permute(0, 2, 3, 1)

    def _cover(self, pictures: Tensor, draws: "_Draws") -> None:
        """Put a rectangle of one grey before all frames, anywhere."""
        height, width = pictures.shape[1:3]
        chosen, most = draws.chosen(), draws.most(self._of.rectangle_px)
        rows, columns = (round(chosen * most * draws.uniform()) for _ in range(2))
        rows, columns = min(rows, height), min(columns, width)
        top = int(draws.uniform() * (height - rows + 1))
        left = int(draws.uniform() * (width - columns + 1))
        pictures[:, top : top + rows, left : left + columns] = 255 * draws.uniform()

    def _blurred(self, pictures: Tensor, draws: "_Draws") -> Tensor:
        """Blur some pictures; half as many as have other effects, since it takes long."""
        chosen, most_px = draws.chosen() * draws.coin(), draws.most(self._of.blur_px)
        width_px = chosen * draws.uniform() * min(most_px, FARTHEST_BLUR_PX)
        if width_px < 0.1:
            return pictures
        reach = math.ceil(BLUR_REACH * width_px)
        taps = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / width_px) ** 2)
        channels = pictures.shape[-1]
        kernel = (taps / taps.sum()).to(pictures).expand(channels, 1, 1, -1)
        padded = F.pad(pictures.permute(0, 3, 1, 2), (reach,) * 4, mode="replicate")
        along = F.conv2d(padded, kernel, groups=channels)
        blurred = F.conv2d(along, kernel.mT, groups=channels)
        return blurred.permute(0, 2, 3, 1)

    def _light(self, pictures: Tensor, draws: "_Draws") -> None:
        """Change the light, let it fall off across, flicker between frames, and bend the curve."""
        frames, height, width, channels = pictures.shape
        gain, chosen = 1 + draws.both_ways(self._of.gain, draws.chosen()), draws.chosen()
        colour = [1 + draws.both_ways(self._of.colour, chosen) for _ in range(channels)]
        chosen = draws.chosen()
        most = draws.most(self._of.flicker) * chosen
        flicker = [1 - most * draws.uniform() for _ in range(frames)]
        factors = gain * torch.tensor(flicker)[:, None] * torch.tensor(colour)
        pictures.mul_(factors[:, None, None].to(pictures))
        fall = draws.most(self._of.gradient) * draws.chosen() * draws.uniform()
        angle = 2 * math.pi * draws.uniform()
        if fall:
            down = math.sin(angle) * torch.linspace(-0.5, 0.5, height)
            right = math.cos(angle) * torch.linspace(-0.5, 0.5, width)
            light = 1 - fall * (0.5 + down[:, None] + right)
            pictures.mul_(light[:, :, None].to(pictures))
        bent = draws.both_ways(self._of.gamma, draws.chosen())
        if bent:  # a parabola through black, white and what the exponent makes of mid-grey
            exponent = 1 + bent if bent > 0 else 1 / (1 - bent)
            bend = 4 * (0.5**exponent - 0.5)
            pictures.clamp_(0, 255)
            pictures.mul_(pictures.mul(-bend / 255).add_(1 + bend))

    def _add_noise(self, pictures: Tensor, drawn: Tensor, draws: "_Draws") -> None:
        """Add noise of the sensor, and of the light, which grows with it, to every value."""
        chosen = draws.chosen()
        read = chosen * draws.most(self._of.read_noise) * draws.uniform()
        shot = chosen * draws.most(self._of.shot_noise) * draws.uniform()
        if shot:
            width = pictures.mul(shot**2 / 255).clamp_(0).add_(read**2).sqrt_()
            pictures.addcmul_(width, drawn)
        elif read:
            pictures.add_(drawn, alpha=read)


class _Draws:
    """It hands out the uniform numbers that were drawn for an input."""

    def __init__(self, settings: AugmentSettings, numbers: list[float]) -> None:
        self._of, self._numbers = settings, iter(numbers)

    def uniform(self) -> float:
        """Return a number from 0 to 1."""
        return next(self._numbers)

    def coin(self) -> int:
        """Return 0 or 1."""
        return int(self.uniform() < 0.5)

    def chosen(self, share: float | None = None) -> int:
        """Return 1 if the input has an effect, else 0; as often as all have it, or ``share`` is."""
        return int(self.uniform() < (self._of.share if share is None else share))

    def most(self, at_one: float) -> float:
        """Return the most of an effect, by what it is at a strength of 1."""
        return at_one * self._of.strength

    def both_ways(self, at_one: float, chosen: int) -> float:
        """Return a severity of an effect up to the most, either way; 0 unless it is chosen."""
        return chosen * self.most(at_one) * (2 * self.uniform() - 1)
