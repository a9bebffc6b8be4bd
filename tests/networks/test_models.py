"""Networks: shapes, exact input handling, symmetries of construction, training of one batch."""

import numpy as np
import pytest
import torch

from hjepa_cli.core.networks.actor import Actor
from hjepa_cli.core.networks.encoder import Encoder
from hjepa_cli.core.networks.hierarchy import Strides, build_predictors
from hjepa_cli.core.networks.predictors import Predictor
from hjepa_cli.core.training.batches import TrajectoryBatch
from hjepa_cli.core.training.jepa import Jepa


def frames(count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (count, 2, 64, 128, 3), dtype=torch.uint8, generator=generator)


@pytest.mark.parametrize("frame_input", ["difference", "pair"])
def test_standardisation_inside_the_stem_equals_standardised_pixels(frame_input: str) -> None:
    torch.manual_seed(0)
    encoder = Encoder(8, frame_input, centre=False)
    images = frames(3)
    encoder.fit_standardisation(images)
    previous, current = images[:, 0].double(), images[:, 1].double()
    second = current - previous if frame_input == "difference" else previous
    pixels = torch.cat([current, second], dim=-1)
    flat = pixels.reshape(-1, 6)
    standardised = (pixels - flat.mean(0)) / flat.std(0)
    expected = torch.nn.functional.conv2d(
        standardised.permute(0, 3, 1, 2), encoder.stem.weight.double(), stride=4
    )
    seen: list[torch.Tensor] = []
    encoder.stem_norm.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    encoder(images)
    torch.testing.assert_close(seen[0].double(), expected, atol=2e-4, rtol=1e-4)


def test_pixels_and_their_differences_are_exact_in_bfloat16() -> None:
    values = torch.arange(-255, 256)
    assert torch.equal(values.bfloat16().long(), values)


def test_embeddings_have_length_sqrt_d_and_do_not_depend_on_the_batch() -> None:
    torch.manual_seed(0)
    encoder = Encoder(256, "difference", centre=True)
    images = frames(6)
    encoder.fit_standardisation(images)
    encoder.train()
    encoder(images)  # running statistics
    encoder.eval()
    with torch.inference_mode():
        together = encoder(images)
        alone = torch.cat([encoder(images[i : i + 1]) for i in range(6)])
    assert together.shape == (6, 256) and together.dtype == torch.float32
    torch.testing.assert_close(together.norm(dim=1), torch.full((6,), 16.0))
    torch.testing.assert_close(together, alone, atol=1e-4, rtol=1e-4)


def test_a_zero_initialised_residual_predictor_is_the_identity_or_the_interpolation() -> None:
    torch.manual_seed(0)
    z = torch.nn.functional.normalize(torch.randn(4, 16), dim=-1) * 4
    waypoint = torch.nn.functional.normalize(torch.randn(4, 16), dim=-1) * 4
    plain = Predictor(16, 32, 4)
    torch.testing.assert_close(plain(z, torch.randn(4, 4)), z)
    guided = Predictor(16, 32, 2, guided=True, distances=4)
    for remaining in (4, 3, 2):
        line = z + (waypoint - z) / remaining
        expected = torch.nn.functional.normalize(line, dim=-1) * 4
        predicted = guided(z, torch.randn(4, 2), waypoint, remaining)
        torch.testing.assert_close(predicted, expected)


@pytest.mark.parametrize(
    ("strides", "inputs"),
    [
        # P^H: z + h actions; P^M, P^L: z, waypoint, actions, and the distance where it varies
        ((4, 2, 1), {"high": 20, "medium": 34, "low": 33, "flat": 17}),
        ((8, 2, 1), {"high": 24, "medium": 35, "low": 33, "flat": 17}),
        ((12, 6, 2), {"high": 28, "medium": 38, "low": 35, "flat": 17}),
    ],
)
def test_inputs_of_every_level(strides: tuple[int, int, int], inputs: dict[str, int]) -> None:
    built = build_predictors(Strides(*strides), 16, 32, all_actions=True, residual=True)
    assert {name: p.hidden.in_features for name, p in built.items()} == inputs
    literal = build_predictors(Strides(*strides), 16, 32, all_actions=False, residual=False)
    assert all(p.actions == 1 for p in literal.values())


def test_held_action_predictor_reads_the_first_action_only() -> None:
    torch.manual_seed(0)
    predictor = Predictor(16, 32, 1, residual=False)
    z, actions = torch.randn(3, 16), torch.randn(3, 4)
    changed = actions.clone()
    changed[:, 1:] += 1.0
    assert torch.equal(predictor(z, actions), predictor(z, changed))
    changed[:, 0] += 1.0
    assert not torch.equal(predictor(z, actions), predictor(z, changed))


def test_actor_clips_only_when_it_acts() -> None:
    torch.manual_seed(0)
    actor = Actor(16, 32, 0.2).eval()
    with torch.no_grad():
        actor.layers[-1].bias.fill_(3.0)
        z = torch.randn(5, 16)
        assert (actor(z) > 1.0).all()
        assert torch.equal(actor.act(z), torch.ones(5))


def test_one_jepa_step_trains_context_and_predictor_but_not_the_target() -> None:
    torch.manual_seed(0)
    jepa = Jepa(
        Encoder(32, "difference", centre=True),
        Predictor(32, 64, 4),
        ema_decay=0.9,
        inverse_dynamics=1.0,
        rollout_strides=3,
        device=torch.device("cpu"),
    )
    batch = TrajectoryBatch(frames(2 * 5), torch.rand(2, 4, 4) * 2 - 1)
    before = [p.clone() for p in jepa.target.module.parameters()]
    terms = jepa.losses(batch)
    assert set(terms) == {"prediction", "inverse_dynamics"}
    total = jepa.total(terms)
    assert total.item() == pytest.approx(sum(term.item() for term in terms.values()), rel=1e-5)
    total.backward()
    assert all(p.grad is not None for p in jepa.encoder.parameters())
    # a residual predictor starts as the identity: only its output layer has a gradient yet
    assert jepa.predictor.output.weight.grad.abs().max() > 0
    for parameter, old in zip(jepa.target.module.parameters(), before, strict=True):
        assert parameter.grad is None and torch.equal(parameter, old)
    with pytest.raises(AssertionError):
        jepa.total({"prediction": terms["prediction"]})


def test_without_inverse_dynamics_there_is_no_such_term() -> None:
    jepa = Jepa(
        Encoder(8, "pair", centre=False),
        Predictor(8, 8, 1, residual=False),
        ema_decay=0.99,
        inverse_dynamics=0.0,
        rollout_strides=1,
        device=torch.device("cpu"),
    )
    terms = jepa.losses(TrajectoryBatch(frames(4), torch.zeros(2, 1, 4)))
    assert set(terms) == {"prediction"}
    assert np.isfinite(terms["prediction"].item())
