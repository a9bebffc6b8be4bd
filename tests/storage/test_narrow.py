"""Weights that fit bfloat16 take half the bytes, and come back as they were."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import torch as safetensors_torch

from hjepa_cli.errors import DataError
from hjepa_cli.storage import tensors
from hjepa_cli.storage.checkpoints import load_checkpoint, save_checkpoint

ROUNDED = torch.randn(40, 50, generator=torch.Generator().manual_seed(0)).bfloat16().float()
ARRAYS = {
    "fits": ROUNDED.numpy(),
    "turned": ROUNDED.numpy().T,
    "fits not": np.float32([1.0, 1.0 + 2**-12]),
    "edges": np.float32([0.0, -0.0, 2**-126, -(2**127), 2**-133]),
    "one": np.array(1.5, np.float32),
    "whole": np.array([3, -4]),
    "none": np.zeros((0, 3), np.float32),
}


def test_what_fits_is_stored_so_and_nothing_is_lost() -> None:
    data = tensors.pack(ARRAYS, "text", narrow=True)
    stored = safetensors_torch.load(data)
    narrow = {name for name, tensor in stored.items() if tensor.dtype == torch.bfloat16}
    assert narrow == {"fits", "turned", "edges", "one", "none"}
    found, text = tensors.unpack(data, Path("x"))
    assert text == "text" and found.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert found[name].dtype == array.dtype and found[name].shape == array.shape, name
        np.testing.assert_array_equal(found[name], array, name)
        assert (np.signbit(found[name]) == np.signbit(array)).all(), name
    assert data == tensors.pack(found, "text", narrow=True)


def test_a_checkpoint_has_one_digest_and_half_the_size(tmp_path: Path) -> None:
    weights = {"w": torch.randn(300, 300).bfloat16().float().numpy()}
    wide, narrow = (
        save_checkpoint(tmp_path / str(flag), weights, {"plant": "p"}, narrow=flag)
        for flag in (False, True)
    )
    assert wide == narrow == load_checkpoint(tmp_path / "True").digest
    sizes = [(tmp_path / name).stat().st_size for name in ("False", "True")]
    assert sizes[0] - sizes[1] == pytest.approx(2 * 300 * 300, abs=16)


def test_other_types_are_still_refused() -> None:
    data = safetensors_torch.save({"x": torch.zeros(2, dtype=torch.float16)})
    with pytest.raises(DataError, match="unexpected dtype F16"):
        tensors.unpack(data, Path("x"))
