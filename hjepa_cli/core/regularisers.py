"""Terms that keep embeddings from collapsing, as alternatives to what the recipe relies on.

The default recipe needs none: inverse dynamics and long rollouts keep the embeddings apart. They
are here to be compared with it. Both look at a batch as a whole, in float32.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

DIRECTIONS = 256
FREQUENCIES = torch.linspace(-5.0, 5.0, 17)


def vicreg(z: Tensor) -> Tensor:
    """Variance and covariance terms of VICReg (Bardes et al. 2022, eqs. 1-4).

    Args:
        z: embeddings [N, D].

    Returns:
        Scalar: how far standard deviations lie below 1, on average, plus the sum of squared
        covariances between different values ÷ D.
    """
    with torch.autocast(z.device.type, enabled=False):
        centred = z.float() - z.float().mean(0)
        samples, values = z.shape
        covariance = centred.T @ centred / (samples - 1)
        variance = covariance.diagonal()
        between = (covariance.square().sum() - variance.square().sum()) / values
        return F.relu(1.0 - (variance + 1e-4).sqrt()).mean() + between


def sigreg(z: Tensor, directions: Tensor | None = None) -> Tensor:
    """Sketched isotropic Gaussian regularisation (Balestriero and LeCun 2025, LeJEPA).

    The Epps-Pulley distance between the distribution of z along random directions and a standard
    normal one: ∫ |φ_N(t) − exp(−t²/2)|² exp(−t²/2) dt, without the usual factor N.

    Args:
        z: embeddings [N, D].
        directions: unit vectors [D, M] to look along; random ones by default.

    Returns:
        Scalar: the mean over directions.
    """
    with torch.autocast(z.device.type, enabled=False):
        if directions is None:
            directions = F.normalize(torch.randn(z.shape[1], DIRECTIONS), dim=0)
        t = FREQUENCIES.to(z.device)
        normal = torch.exp(-t.square() / 2)
        phases = (z.float() @ directions.to(z.device)).unsqueeze(-1) * t
        real, imaginary = phases.cos().mean(0) - normal, phases.sin().mean(0)
        distance: Tensor = torch.trapezoid(
            (real.square() + imaginary.square()) * normal, t, dim=-1
        ).mean()
        return distance


REGULARISERS = {"vicreg": vicreg, "sigreg": sigreg}
