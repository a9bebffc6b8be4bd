"""Payloads: their bits, what survives them, and principal components against numpy's SVD."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from test_integers import reference

from hjepa_cli.config.checks import check_payload
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.codecs.principal_components import fit_components
from hjepa_cli.core.networks.encoder import normalise
from hjepa_cli.core.plants.named import plant
from hjepa_cli.errors import UsageError
from hjepa_cli.plugins import CODECS


class Seen:
    """A stand-in for a model: embeddings that are a smooth function of the pole's pixels."""

    plant_name, architecture = "desktop", {"embedding": 16}
    camera, look, device = plant("desktop").camera(), (2, 1), "cpu"

    def __init__(self):
        self.mix = torch.from_numpy(np.random.default_rng(0).normal(size=(16, 16))).float()

    def encode(self, frames):
        columns = torch.from_numpy(frames).float().mean((2, 4)).reshape(len(frames), 2, 8, -1)
        return normalise(columns.mean(-1).flatten(1) @ self.mix)


SETTINGS = load_settings(
    flags={"collect.trajectories": 4, "collect.steps": 25, "control.gains_n": []}
)


@pytest.mark.parametrize(
    ("name", "bits"),
    [
        ("float32", 8192),
        ("float16", 4096),
        ("int8", 2064),
        ("int4", 1040),
        ("pca-8x6", 48),
        ("pca-16x8", 128),
    ],
)
def test_bits(name, bits):
    assert CODECS[name].bits(256) == bits


def test_floats_and_integers():
    z = normalise(torch.from_numpy(np.random.default_rng(0).normal(size=(50, 16))).float())
    seen = {name: CODECS[name].fit(Seen(), SETTINGS) for name in ("float32", "float16", "int4")}
    assert torch.equal(seen["float32"].send(z), z)
    assert torch.equal(seen["float16"].send(z), z.half().float())
    assert seen["int4"].send(z).numpy() == pytest.approx(reference(z.numpy(), 4), abs=1e-5)
    assert [CODECS[name].bits(16) for name in seen] == [512, 256, 80]


def correlated(count, seed=0):
    random = np.random.default_rng(seed)
    axes = np.linalg.qr(np.random.default_rng(99).normal(size=(32, 32)))[0]
    z = random.normal(size=(count, 32)) * 0.5 ** np.arange(32) @ axes
    return normalise(torch.from_numpy(z + 2 * axes[7]).float())


def test_components_are_those_of_the_singular_value_decomposition():
    z = correlated(500)
    codec = fit_components(z, 5, 16)
    _, _, rows = np.linalg.svd(z.double().numpy() - z.double().numpy().mean(0))
    overlap = np.abs(codec.components.double().numpy() @ rows[:5].T)
    assert overlap == pytest.approx(np.eye(5), abs=1e-4)
    # Fine steps: what is lost is the energy outside of the components, up to the fixed length.
    centred = z - codec.mean
    outside = centred - centred @ codec.components.T @ codec.components
    lost = (codec.send(z) - z).norm(dim=1)
    assert lost.numpy() == pytest.approx(outside.norm(dim=1).numpy(), abs=2e-2)


@pytest.mark.parametrize("bits", [1, 4, 8])
def test_codes_fit_their_bits_and_steps_bound_the_error(bits):
    z, other = correlated(500), correlated(200, seed=1)
    codec = fit_components(z, 3, bits)
    codes = codec.encode(torch.cat([z, 100 * other]))
    assert codes.min() >= 0 and codes.max() < 2**bits and codes.dtype == torch.int32
    coefficients = (z - codec.mean) @ codec.components.T
    step = codec.reach * 2.0 / 2**bits
    decoded = ((codec.encode(z).float() + 0.5) / 2**bits * 2 - 1) * codec.reach
    assert torch.all((decoded - coefficients).abs() <= step / 2 * (1 + 1e-4))
    lengths = codec.send(z).norm(dim=1).numpy()
    assert lengths == pytest.approx(np.full(500, math.sqrt(32)), rel=1e-5)


def test_more_bits_and_components_lose_less():
    z = correlated(1000)
    loss = {
        (n, b): float((fit_components(z, n, b).send(z) - z).square().mean())
        for n, b in ((2, 8), (6, 8), (6, 4))
    }
    assert loss[6, 8] < loss[2, 8] and loss[6, 8] < loss[6, 4]


def test_components_are_fitted_to_the_seed_s_trajectories_and_nothing_else():
    first, second = (CODECS["pca-4x6"].fit(Seen(), SETTINGS) for _ in range(2))
    assert torch.equal(first.components, second.components)
    assert torch.equal(first.reach, second.reach)
    other = CODECS["pca-4x6"].fit(Seen(), dataclasses.replace(SETTINGS, seed=1))
    assert not torch.equal(first.reach, other.reach)
    with pytest.raises(UsageError, match="16 values"):
        CODECS["pca-17x6"].fit(Seen(), SETTINGS)


@pytest.mark.parametrize(
    "name",
    ["", "int1", "int17", "int", "float64", "pca", "pca-8", "pca-0x6", "pca-8x0", "pca-8x17"],
)
def test_unknown_payloads_name_the_choices(name):
    with pytest.raises(UsageError, match="pca-8x6"):
        check_payload(name)
