"""Pictures are seen against their background, so that light and black level do not matter.

A camera's value is gain × scene + offset, in each channel. Where most of a picture is background,
its level L is the same statistic whatever the objects do, and what the encoder should see is how
far pixels are from it. L is a median of means: in a quarter of the columns, of nine bands of rows
each, the median by threes of their means, and then the median of the columns. Bands of one three
lie a third of the picture apart, so that no single object hides two of them. The means make L a
finer number than the camera's whole grey levels. A median of all of these at once takes longer than
all else here together.
"""

import torch
from torch import Tensor

FITS = ("none", "gain", "affine")
APART_PX = 8  # of such columns the first and the last: a mirror image has the same ones
WHITE = 255.0
CONTRAST = 85.0  # about the spread of a cart-pole's picture: keeps values in grey levels
LEAST = 1.0  # grey level and spread of a picture that shows nothing


def against_background(frames: Tensor, fit: str) -> Tensor:
    """Return frames [N, H, W, C] as departures from their background, float32.

    Below 1 grey level, L and the spread are taken for 1: a black picture is all background.

    Args:
        frames: uint8 or floating.
        fit: ``"gain"`` returns 255 (p/L − 1), equal under any gain of a channel. ``"affine"``
            returns p − L in units of its spread, equal under any gain and offset of a channel. The
            spread is the fourth root of the mean of (p − L)⁴ in every second row, which strong
            contrast decides: noise, gradients and grey objects count little beside the scene's own
            darkest parts.
    """
    level, width = _background(frames), frames.shape[2]
    # A row of pixels is one run in memory: what is the same for all of them costs least along it.
    apart = frames.to(torch.float32, copy=True).flatten(2).sub_(level.repeat(1, width)[:, None])
    if fit == "gain":
        factor = WHITE / level.clamp_min(LEAST)
    else:
        half = apart[:, ::2].square().square_()
        fourth = half.sum(1).view(frames.shape[0], width, frames.shape[3]).sum(1)
        spread = (fourth / (half.shape[1] * width)).sqrt().sqrt()
        factor = CONTRAST / spread.clamp_min(LEAST)
    return apart.mul_(factor.repeat(1, width)[:, None]).view(frames.shape)


def _background(frames: Tensor) -> Tensor:
    """Return the level [N, C] of the background of frames [N, H, W, C]."""
    rows = frames.shape[1] // 9
    columns = torch.cat([frames[:, :, ::APART_PX], frames[:, :, APART_PX - 1 :: APART_PX]], 2)
    bands = columns[:, : 9 * rows].reshape(-1, 3, 3, rows, *columns.shape[2:]).float().mean(3)
    columns = _middle(_middle(bands))
    return columns.sort(1).values[:, (columns.shape[1] - 1) // 2]  # their median: ONNX has none


def _middle(threes: Tensor) -> Tensor:
    """Return the medians [N, ...] of threes [N, 3, ...]."""
    one, two, three = threes.unbind(1)
    low, high = torch.minimum(one, two), torch.maximum(one, two)
    return torch.maximum(low, torch.minimum(high, three))
