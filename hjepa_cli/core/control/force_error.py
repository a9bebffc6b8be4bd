"""A controller's forces err by their distance from the teacher's, or a fresh packet's."""

from collections.abc import Sequence

import numpy as np

from hjepa_cli.core.arrays import Floats

WINDOWS = ((1, 20), (21, 40), (41, 80), (81, 100))


def control_error(forces_n: Floats, teacher_n: Floats, force_limit_n: float) -> Floats:
    """Return |ũ − u*| ÷ the force range, 2 · limit, elementwise; its mean is the NMAE."""
    return np.abs(forces_n - teacher_n) / (2 * force_limit_n)


def window_means(error: Floats, windows: Sequence[tuple[int, int]] = WINDOWS) -> dict[str, Floats]:
    """Average the control error over the windows of the horizon, both ends included.

    Args:
        error: [..., J + 1], ``error[..., j]`` is j steps after the transmission.
        windows: (first j, last j); windows beyond J are cut short or left out.

    Returns:
        ``{"1-20": [...], ...}``.
    """
    last = error.shape[-1] - 1
    return {
        f"{first}-{end}": error[..., first : end + 1].mean(axis=-1)
        for first, end in windows
        if first <= last
    }
