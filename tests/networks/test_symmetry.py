"""Networks that commute with a mirror: exactly, for any weights, folded or not."""

import pytest
import torch
from torch import Tensor, nn

from hjepa_cli.core.networks.actor import Actor
from hjepa_cli.core.networks.encoder import Encoder
from hjepa_cli.core.networks.hierarchy import Strides, build_predictors, plan_stride
from hjepa_cli.core.networks.symmetry import (
    MirrorConv2d,
    MirrorLinear,
    MirrorNorm2d,
    Signs,
    Twins,
    flatten_twins,
    force_signs,
    reflect,
)
from hjepa_cli.core.training.losses import InverseDynamics

TOLERANCE = {"atol": 2e-5, "rtol": 1e-4}


def frames(count: int) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, (count, 2, 64, 128, 3), dtype=torch.uint8, generator=generator)


def scramble(module: nn.Module) -> nn.Module:
    """Random weights everywhere: nothing may hold only because something starts at zero."""
    generator = torch.Generator().manual_seed(1)
    for parameter in module.parameters():
        scale = parameter[0].numel() ** -0.5 if parameter.dim() > 1 else 0.5
        parameter.data = scale * torch.randn(parameter.shape, generator=generator)
    return module


def swap(x: Tensor, dim: int = -1) -> Tensor:
    """The mirror image of twins."""
    right, left = x.chunk(2, dim=dim)
    return torch.cat([left, right], dim=dim)


def mirrored_maps(x: Tensor) -> Tensor:
    return swap(x, dim=1).flip(-1)


@pytest.mark.parametrize(
    "factors", [(1.0, -1.0), (-1.0, 1.0), (1.0, -1.0, -1.0, 1.0, 1.0, -1.0, 1.0)]
)
def test_a_linear_layer_from_signs_to_twins_and_back(factors: tuple[float, ...]) -> None:
    torch.manual_seed(0)
    signs = torch.tensor(factors)
    into = MirrorLinear(Signs(force_signs(factors)), Twins(10))
    between, back = (
        MirrorLinear(Twins(10), Twins(6)),
        MirrorLinear(Twins(6), Signs(force_signs(factors))),
    )
    x = torch.randn(5, len(factors))
    torch.testing.assert_close(into(signs * x), swap(into(x)), **TOLERANCE)
    hidden = into(x)
    torch.testing.assert_close(between(swap(hidden)), swap(between(hidden)), **TOLERANCE)
    through, of_mirror = (back(between(into(x).relu()).relu()) for x in (x, signs * x))
    torch.testing.assert_close(of_mirror, signs * through, **TOLERANCE)
    assert (through[:, signs > 0].std(0) > 1e-3).all() and (
        through[:, signs < 0].std(0) > 1e-3
    ).all()


def test_any_linear_map_that_commutes_with_the_mirror_can_be_expressed() -> None:
    # Projecting an arbitrary matrix onto the commuting ones, and reading off E and O.
    torch.manual_seed(0)
    signs = torch.tensor([1.0, -1.0, 1.0])
    matrix = torch.randn(4, 3)
    commuting = (matrix + swap(matrix, dim=0) * signs) / 2
    layer = MirrorLinear(Signs(force_signs(signs.tolist())), Twins(4))
    with torch.no_grad():
        assert layer.even is not None and layer.odd is not None
        layer.even.bias.zero_()
        halves = (commuting[:2] + commuting[2:], commuting[:2] - commuting[2:])
        layer.even.weight.copy_(halves[0][:, signs > 0] * 0.5**0.5)
        layer.odd.weight.copy_(halves[1][:, signs < 0] * 0.5**0.5)
    x = torch.randn(6, 3)
    torch.testing.assert_close(layer(x), x @ commuting.T, **TOLERANCE)


@pytest.mark.parametrize(("kernel", "stride", "padding"), [(3, 1, 1), (2, 2, 0), (1, 1, 0)])
def test_convolutions_and_norms_of_twins(kernel: int, stride: int, padding: int) -> None:
    torch.manual_seed(0)
    layer = MirrorConv2d(6, 8, kernel, stride, padding, bias=True)
    norm = MirrorNorm2d(8)
    scramble(norm)
    x = torch.randn(5, 6, 8, 12).contiguous(memory_format=torch.channels_last)
    y = norm(layer(x))
    norm.eval()
    torch.testing.assert_close(layer(mirrored_maps(x)), mirrored_maps(layer(x)), **TOLERANCE)
    torch.testing.assert_close(
        norm(layer(mirrored_maps(x))), mirrored_maps(norm(layer(x))), **TOLERANCE
    )
    assert y.shape == (5, 8, 8 // stride, 12 // stride)
    ordinary = norm.ordinary()(layer.ordinary()(x))
    torch.testing.assert_close(ordinary, norm(layer(x)), **TOLERANCE)


def test_the_norm_of_twins_takes_its_statistics_over_both() -> None:
    torch.manual_seed(0)
    x = torch.randn(4, 6, 3, 5) * 3 + 1
    normed = MirrorNorm2d(6)(x)
    pooled = torch.stack(normed.chunk(2, dim=1)).transpose(0, 2).flatten(1)
    torch.testing.assert_close(pooled.mean(1), torch.zeros(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(pooled.var(1, unbiased=False), torch.ones(3), atol=1e-4, rtol=0)


def test_flattened_maps_are_twins_without_a_place() -> None:
    x = torch.randn(3, 4, 2, 6)
    assert torch.equal(flatten_twins(mirrored_maps(x)), swap(flatten_twins(x)))


@pytest.mark.parametrize("centre", [True, False])
@pytest.mark.parametrize("frame_input", ["difference", "pair"])
def test_a_mirrored_picture_has_the_reflected_embedding(centre: bool, frame_input: str) -> None:
    encoder = Encoder(16, frame_input, centre, symmetric=True)
    scramble(encoder)
    images = frames(8)
    images[..., :40, :] //= 4  # darker on the left
    encoder.fit_standardisation(images)
    encoder.train()
    for _ in range(3):
        encoder(images)  # running statistics, from pictures that are not symmetric
    encoder.eval()
    with torch.no_grad():
        z, of_mirror = encoder(images), encoder(images.flip(-2))
        torch.testing.assert_close(of_mirror, reflect(z), **TOLERANCE)
        torch.testing.assert_close(encoder.folded()(images), z, atol=1e-3, rtol=1e-3)
        torch.testing.assert_close(z.norm(dim=1), torch.full((8,), 4.0))
    odd = z[:, 8:]
    assert odd.abs().max() > 1e-2  # the odd half is used
    own_image = torch.cat([images[:, :, :, :64], images[:, :, :, :64].flip(-2)], dim=-2)
    with torch.no_grad():
        assert encoder(own_image)[:, 8:].abs().max() < 1e-4  # and 0 where left is right


def test_training_a_symmetric_encoder_moves_every_weight() -> None:
    encoder = Encoder(16, "difference", True, symmetric=True)
    encoder.fit_standardisation(frames(6))
    (encoder(frames(6)) * torch.randn(6, 16)).sum().backward()
    assert all(parameter.grad is not None for parameter in encoder.parameters())


@pytest.mark.parametrize("force_signs", [(-1.0,), (1.0, -1.0)])
def test_a_mirrored_stride_is_the_mirror_image_of_the_stride(
    force_signs: tuple[float, ...],
) -> None:
    signs = torch.tensor(force_signs)
    shape = () if len(force_signs) == 1 else (len(force_signs),)
    strides = Strides(8, 2, 1)
    built = build_predictors(
        strides,
        16,
        32,
        all_actions=True,
        residual=True,
        forces=len(force_signs),
        mirror=force_signs,
    )
    for predictor in built.values():
        scramble(predictor)
    actor = Actor(16, 32, 0.2, shape, force_signs).eval()
    scramble(actor)
    z = torch.nn.functional.normalize(torch.randn(7, 16), dim=-1) * 4
    levels = [built[name] for name in ("high", "medium", "low")]

    def play(z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return plan_stride(actor.act, *levels, z, strides, recompute_waypoint=True)

    with torch.no_grad():
        actions, embeddings, waypoint = play(z)
        of_mirror = play(reflect(z))
    mirror = signs if shape else signs[0]
    torch.testing.assert_close(of_mirror[0], mirror * actions, **TOLERANCE)
    torch.testing.assert_close(of_mirror[1], reflect(embeddings), **TOLERANCE)
    torch.testing.assert_close(of_mirror[2], reflect(waypoint), **TOLERANCE)
    assert actions.std() > 1e-2


def test_an_upright_pole_gets_no_force() -> None:
    actor = Actor(16, 32, 0.2, (), (-1.0,)).eval()
    scramble(actor)
    z = torch.cat([torch.randn(5, 8), torch.zeros(5, 8)], dim=1)
    assert not actor(z).any()


def test_inverse_dynamics_of_a_mirrored_stride() -> None:
    head = InverseDynamics(16, 8, mirror=(-1.0,))
    scramble(head)
    z, z_next, action = torch.randn(5, 16), torch.randn(5, 16), torch.randn(5)
    torch.testing.assert_close(
        head.loss(reflect(z), reflect(z_next), -action), head.loss(z, z_next, action), **TOLERANCE
    )
