"""A controller's forces err by their distance from the teacher's, or a fresh packet's."""

import numpy as np

from hjepa_cli.core.arrays import Floats

WINDOWS = ((1, 20), (21, 40), (41, 80), (81, 100))


def control_error(forces_n: Floats, teacher_n: Floats, force_limit_n: float) -> Floats:
    """Return |ũ − u*| ÷ the force range, 2 · limit, elementwise; its mean is the NMAE."""
    return np.abs(forces_n - teacher_n) / (2 * force_limit_n)


def window_means(error: Floats) -> dict[str, Floats]:
    """Average the control error over :data:`WINDOWS` of the horizon, both ends included.

    ``error[..., j]``, j = 0 … J, is j steps after the transmission; windows beyond J are cut short
    or left out. Returns ``{"1-20": [...], ...}``.
    """
    last = error.shape[-1] - 1
    return {
        f"{first}-{end}": error[..., first : end + 1].mean(axis=-1)
        for first, end in WINDOWS
        if first <= last
    }
