"""Networks compute on a device, in some precision, and keep their memory."""

import ctypes
import sys
from contextlib import AbstractContextManager

import torch

from hjepa_cli.errors import UsageError


def resolve_device(name: str) -> torch.device:
    """Return a device; ``auto`` is the GPU where there is one.

    Raises:
        UsageError: ``cuda`` was asked for and is not there.
    """
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise UsageError("--device cuda: no CUDA device is visible; choose auto or cpu")
    return torch.device("cuda" if available and name != "cpu" else "cpu")


def autocast(device: torch.device, precision: str) -> AbstractContextManager[object]:
    """Return the context in which torch computes in :func:`compute_dtype`."""
    enabled = compute_dtype(device, precision) == torch.bfloat16
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=enabled)


def compute_dtype(device: torch.device, precision: str) -> torch.dtype:
    """Return what layers compute in for a precision: auto (as the hardware has it), bf16, fp32."""
    if precision != "auto":
        fast = precision == "bf16"
    elif device.type == "cuda":
        fast = torch.cuda.is_bf16_supported()
    else:
        fast = torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    return torch.bfloat16 if fast else torch.float32


def keep_freed_memory() -> None:
    """Let glibc, where there is one, keep large freed buffers for the next training step.

    By default it returns them to the kernel, which then fills new pages with zeros at every step: a
    tenth of the time of training and of the closed loop.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(-3, 2**30)  # M_MMAP_THRESHOLD
        mallopt(-1, 2**31 - 1)  # M_TRIM_THRESHOLD: never
