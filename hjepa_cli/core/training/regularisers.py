"""These terms keep embeddings from collapsing, each looking at a batch as a whole, in float32.

The default recipe needs none: inverse dynamics and long rollouts keep the embeddings apart. They
are here to be compared with it.
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hjepa_cli.compute.seeding import generator

DIRECTIONS = 256
_DIRECTIONS_KEY = 0x51C
FREQUENCIES = torch.linspace(-5.0, 5.0, 17)


def vicreg(z: Tensor) -> Tensor:
    """Return the variance and covariance terms of VICReg (Bardes et al. 2022, eqs. 1-4).

    For embeddings [N, D] they are how far standard deviations lie below 1, on average, plus the
    sum of squared covariances between different values ÷ D.
    """
    with torch.autocast(z.device.type, enabled=False):
        centred = z.float() - z.float().mean(0)
        samples, values = z.shape
        covariance = centred.T @ centred / (samples - 1)
        variance = covariance.diagonal()
        between = (covariance.square().sum() - variance.square().sum()) / values
        return F.relu(1.0 - (variance + 1e-4).sqrt()).mean() + between


def sigreg(z: Tensor, directions: Tensor) -> Tensor:
    """Return the sketched isotropic Gaussian regulariser (Balestriero and LeCun 2025, LeJEPA).

    The Epps-Pulley distance between the distribution of z [N, D] along a direction and a standard
    normal one, ∫ |φ_N(t) − exp(−t²/2)|² exp(−t²/2) dt without the usual factor N, is averaged over
    ``directions``, unit vectors [D, M].
    """
    with torch.autocast(z.device.type, enabled=False):
        t = FREQUENCIES.to(z.device)
        normal = torch.exp(-t.square() / 2)
        phases = (z.float() @ directions.to(z.device)).unsqueeze(-1) * t
        real, imaginary = phases.cos().mean(0) - normal, phases.sin().mean(0)
        distance: Tensor = torch.trapezoid(
            (real.square() + imaginary.square()) * normal, t, dim=-1
        ).mean()
        return distance


class Sigreg(nn.Module):
    """:func:`sigreg` looks along other random directions at every call.

    They come from a stream of its own, since the probes that watch a training seed torch's again.
    Its state is a buffer: a saved training goes on with the directions that it would have had.
    """

    state: Tensor

    def __init__(self, seed: int) -> None:
        super().__init__()
        own = int(generator(seed, _DIRECTIONS_KEY).integers(2**63))
        self.register_buffer("state", torch.Generator().manual_seed(own).get_state())

    def forward(self, z: Tensor) -> Tensor:
        stream = torch.Generator().set_state(self.state)
        drawn = torch.randn(z.shape[1], DIRECTIONS, generator=stream)
        self.state.copy_(stream.get_state())
        return sigreg(z, F.normalize(drawn, dim=0))


Regulariser = Callable[[Tensor], Tensor]
"""It maps embeddings [N, D] to a scalar."""

# Each is made for the seed of a training.
REGULARISERS: dict[str, Callable[[int], Regulariser]] = {
    "vicreg": lambda seed: vicreg,
    "sigreg": Sigreg,
}
