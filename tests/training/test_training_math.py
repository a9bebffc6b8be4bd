"""The sums inside training, each against a closed form or a fake that shows what it was given.

A fake embedding of step k is the pair (trajectory, k), so that whatever a loss hands to a predictor
says which frame it is; see test_hierarchy.py for the alignment of the levels.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from hjepa_cli.compute.device import autocast
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.networks.actor import Actor
from hjepa_cli.core.networks.encoder import Encoder
from hjepa_cli.core.networks.model import encode_frames
from hjepa_cli.core.networks.predictors import Predictor
from hjepa_cli.core.training.batches import FrameWindows, TrajectoryBatch, window_indices
from hjepa_cli.core.training.jepa import Jepa
from hjepa_cli.core.training.levels import (
    EmbeddedTrajectories,
    flat_loss,
    high_gaps,
    low_loss,
    medium_loss,
)
from hjepa_cli.core.training.losses import rollout_loss
from hjepa_cli.core.training.optimiser import Optimiser, fit_actor

CPU = torch.device("cpu")
WINDOWS, FRAMES, STRIDE, WIDTH = 3, 4, 2, 5


# ---- JEPA ------------------------------------------------------------------------------------


class TinyEncoder(nn.Module):
    """Linear in the pixels of frames [N, 2, 1, 2, 3]."""

    def __init__(self) -> None:
        super().__init__()
        self.embedding = WIDTH
        self.head = nn.Linear(12, WIDTH)

    def forward(self, frames: Tensor) -> Tensor:
        return self.head(frames.float().flatten(1) / 255.0)


class Still(nn.Module):
    """Predicts that nothing changes."""

    def forward(self, z: Tensor, actions: Tensor) -> Tensor:
        return z


def jepa(**changes: float) -> Jepa:
    torch.manual_seed(0)
    options = {"ema_decay": 0.75, "inverse_dynamics": 0.25, "rollout_strides": 1} | changes
    return Jepa(TinyEncoder(), Still(), device=CPU, **options)  # type: ignore[arg-type]


def batch() -> TrajectoryBatch:
    torch.manual_seed(1)
    frames = torch.randint(0, 256, (WINDOWS * FRAMES, 2, 1, 2, 3), dtype=torch.uint8)
    return TrajectoryBatch(frames, torch.rand(WINDOWS, FRAMES - 1, STRIDE) * 2 - 1)


def embeddings(module: nn.Module, frames: Tensor) -> np.ndarray:
    with torch.no_grad():
        return module(frames).reshape(WINDOWS, FRAMES, WIDTH).double().numpy()


def test_predictions_are_compared_with_the_target_encoder() -> None:
    model, data = jepa(), batch()
    with torch.no_grad():  # as different from the context encoder as can be
        model.target.module.head.weight.copy_(torch.randn(WIDTH, 12))
    z, target = (embeddings(m, data.frames) for m in (model.encoder, model.target.module))
    predicted, truth = z[:, :-1], target[:, 1:]
    lengths = np.linalg.norm(predicted, axis=-1) * np.linalg.norm(truth, axis=-1)
    cosines = (predicted * truth).sum(-1) / lengths
    assert model.losses(data)["prediction"].item() == pytest.approx(1 - cosines.mean(), abs=1e-5)


def test_gradients_reach_the_context_encoder_only() -> None:
    model = jepa()
    model.total(model.losses(batch())).backward()
    assert model.encoder.head.weight.grad.abs().sum() > 0
    assert all(p.grad is None for p in model.target.module.parameters())


def test_updating_the_target_moves_it_by_one_minus_the_decay() -> None:
    model = jepa(ema_decay=0.75)
    before = model.target.module.head.weight.clone()
    with torch.no_grad():
        model.encoder.head.weight.add_(1.0)
    model.after_step()
    torch.testing.assert_close(model.target.module.head.weight, before + 0.25)


def test_inverse_dynamics_sees_neighbouring_frames_and_the_mean_action(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model, data = jepa(), batch()
    seen: list[Tensor] = []

    def record(z: Tensor, z_next: Tensor, action: Tensor) -> Tensor:
        seen.extend((z, z_next, action))
        return torch.zeros(())

    assert model.inverse is not None
    monkeypatch.setattr(model.inverse, "loss", record)
    model.losses(data)
    z = embeddings(model.encoder, data.frames)
    expected = (z[:, :-1], z[:, 1:], data.actions.double().numpy().mean(-1))
    for given, wanted in zip(seen, expected, strict=True):
        flat = wanted.reshape(given.shape)
        np.testing.assert_allclose(given.detach().numpy(), flat, rtol=1e-5, atol=1e-6)


def test_the_total_weighs_its_terms() -> None:
    model = jepa(inverse_dynamics=0.25)
    terms = {"prediction": torch.tensor(2.0), "inverse_dynamics": torch.tensor(8.0)}
    assert model.total(terms).item() == 4.0
    with pytest.raises(AssertionError):
        model.total({"prediction": torch.tensor(2.0)})
    alone = jepa(inverse_dynamics=0.0)
    assert alone.losses(batch()).keys() == {"prediction"}


def test_rollouts_are_as_long_as_asked_for() -> None:
    for strides in (1, 2, 3):
        model = jepa(rollout_strides=strides)
        calls: list[int] = []
        model.predictor.register_forward_hook(lambda *_, calls=calls: calls.append(1))
        model.losses(batch())
        assert len(calls) == strides


def test_the_rollout_loss_is_differentiable_from_end_to_start() -> None:
    """Analytic against numeric gradient: nothing is detached but the targets."""
    torch.manual_seed(2)
    mix = torch.randn(3 + STRIDE, 3, dtype=torch.float64)
    targets = torch.randn(2, FRAMES, 3, dtype=torch.float64)
    actions = torch.randn(2, FRAMES - 1, STRIDE, dtype=torch.float64)
    z = torch.randn(2, FRAMES, 3, dtype=torch.float64, requires_grad=True)

    def predict(z: Tensor, actions: Tensor) -> Tensor:
        return torch.tanh(torch.cat([z, actions], dim=-1) @ mix)

    def loss(z: Tensor) -> Tensor:
        return rollout_loss(predict, z, targets, actions, torch.tensor([0, 2]), 3)

    assert torch.autograd.gradcheck(loss, (z,))
    (gradient,) = torch.autograd.grad(loss(z), z)
    reached = gradient.abs().sum((0, 2)) > 0
    assert reached.tolist() == [True, False, True, False]  # the starts, and they alone


# ---- networks --------------------------------------------------------------------------------


def predictor(**changes: object) -> Predictor:
    """A predictor whose output is all network: no residual path could stand in for an input."""
    torch.manual_seed(3)
    options = {"guided": True, "distances": 4, "residual": False} | changes
    return Predictor(6, 32, 3, **options).eval()  # type: ignore[arg-type]


def inputs() -> dict[str, Tensor]:
    torch.manual_seed(4)
    return {"z": torch.randn(5, 6), "actions": torch.rand(5, 3), "waypoint": torch.randn(5, 6)}


@pytest.mark.parametrize("name", ["z", "actions", "waypoint"])
def test_every_value_of_every_input_reaches_the_network(name: str) -> None:
    network, given = predictor(), inputs()
    before = network(**given, remaining=3)
    for column in range(given[name].shape[1]):
        changed = given[name].clone()
        changed[:, column] += 0.5
        after = network(**(given | {name: changed}), remaining=3)
        assert ((after - before).abs().amax(-1) > 1e-4).all(), column


def test_the_remaining_distance_reaches_the_network_where_it_varies() -> None:
    outputs = [predictor()(**inputs(), remaining=remaining) for remaining in (4, 3, 2)]
    for one, other in itertools.pairwise(outputs):
        assert ((one - other).abs().amax(-1) > 1e-4).all()
    constant = predictor(distances=2)  # nothing varies: it is no input
    assert torch.equal(constant(**inputs(), remaining=2), constant(**inputs(), remaining=1))
    assert constant.hidden.in_features == predictor().hidden.in_features - 1


@pytest.mark.parametrize("remaining", [1, 2, 4])
def test_an_untrained_residual_predictor_walks_straight_to_its_anchor(remaining: int) -> None:
    given = inputs()
    walked = predictor(residual=True)(**given, remaining=remaining)
    point = given["z"] + (given["waypoint"] - given["z"]) / remaining
    expected = math.sqrt(6) * point / point.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(walked, expected)
    alone = predictor(residual=True, guided=False, distances=1)
    stays = alone(given["z"], given["actions"])
    cosine = torch.cosine_similarity(stays, given["z"], dim=-1)
    torch.testing.assert_close(cosine, torch.ones(5))


def test_centred_embeddings_are_offset_by_one_before_their_length_is_fixed() -> None:
    """With the head's weights at zero, its bias is the centred embedding."""
    encoder = Encoder(4, "difference", True).eval()
    frame = torch.zeros(1, 2, 64, 128, 3, dtype=torch.uint8)
    for centred in ([0.0, 0.0, 0.0, 0.0], [3.0, -1.0, 0.5, -2.0]):
        with torch.no_grad():
            encoder.head.weight.zero_()
            encoder.head.bias.copy_(torch.tensor(centred))
            z = encoder(frame)[0].numpy()
        shifted = np.array(centred) + 1.0
        np.testing.assert_allclose(z, 2.0 * shifted / np.linalg.norm(shifted), atol=1e-4)


def test_a_symmetric_encoder_has_its_offset_in_the_even_half() -> None:
    """As long as the other, and its own reflection."""
    offset = Encoder(8, "difference", True, symmetric=True).offset
    torch.testing.assert_close(offset, torch.tensor([2.0**0.5] * 4 + [0.0] * 4))
    assert offset.norm() == pytest.approx(Encoder(8, "difference", True).offset.norm())


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("centre", [True, False])
def test_a_folded_encoder_is_the_same_function(centre: bool, symmetric: bool) -> None:
    """Batch norms with arbitrary statistics and affine parts, moved into the convolutions."""
    torch.manual_seed(0)
    encoder = Encoder(16, "difference", centre, symmetric)
    with torch.no_grad():
        for layer in encoder.modules():
            if isinstance(layer, torch.nn.BatchNorm2d | torch.nn.BatchNorm1d):
                layer.running_mean.normal_()
                layer.running_var.uniform_(0.5, 2.0)
                if layer.affine:
                    layer.weight.uniform_(0.5, 1.5)
                    layer.bias.normal_()
    frames = torch.randint(0, 256, (4, 2, 64, 128, 3), dtype=torch.uint8)
    encoder.fit_standardisation(frames)
    encoder.eval()
    folded = encoder.folded()
    assert not [m for m in folded.modules() if isinstance(m, torch.nn.BatchNorm2d)]
    with torch.no_grad():
        torch.testing.assert_close(folded(frames), encoder(frames), atol=1e-4, rtol=1e-4)


def test_the_actor_drops_units_in_training_and_none_in_evaluation() -> None:
    torch.manual_seed(5)
    z = torch.randn(1, 8).expand(400, -1)
    dropping, full = Actor(8, 64, 0.2), Actor(8, 64, 0.0)
    full.load_state_dict(dropping.state_dict())
    with torch.no_grad():
        assert dropping.train()(z).std() > 1e-3
        assert full.train()(z).std() < 1e-6
        torch.testing.assert_close(dropping.eval()(z), full(z))


# ---- levels on embeddings --------------------------------------------------------------------


def fake(trajectories: int, steps: int) -> EmbeddedTrajectories:
    """z = (trajectory, k), action = k."""
    k = torch.arange(steps, dtype=torch.float32).expand(trajectories, -1)
    rows = torch.arange(trajectories, dtype=torch.float32)[:, None].expand(-1, steps)
    return EmbeddedTrajectories(torch.stack([rows, k], dim=-1), k.contiguous())


class Drift:
    """Moves time by its stride, errs by ``error`` in the other value, and remembers its inputs."""

    def __init__(self, stride: int, error: float = 0.0) -> None:
        self.change = torch.tensor([error, float(stride)])
        self.seen: list[Tensor] = []
        self.waypoints: list[Tensor | None] = []

    def __call__(
        self, z: Tensor, actions: Tensor, waypoint: Tensor | None = None, remaining: int = 1
    ) -> Tensor:
        self.seen.append(z)
        self.waypoints.append(waypoint)
        return z + self.change


@pytest.mark.parametrize(
    ("horizon_steps", "stride", "calls"),
    [(8, 1, 8), (8, 2, 4), (7, 2, 3), (1, 4, 1), (400, 4, 12)],
)
def test_flat_rollouts_are_k_p_control_steps_long(
    horizon_steps: int, stride: int, calls: int
) -> None:
    data, drift = fake(3, 50), Drift(stride)
    flat_loss(
        drift,  # type: ignore[arg-type]
        data,
        stride,
        horizon_steps=horizon_steps,
        trajectories=3,
        starts=49,  # every frame, so that the longest rollout is as long as the window allows
        generator=np.random.default_rng(0),
    )
    assert len(drift.seen) == calls


def test_flat_rollouts_start_at_different_frames_all_over_the_window() -> None:
    data, stream = fake(4, 41), np.random.default_rng(1)
    started: set[float] = set()
    for _ in range(30):
        drift = Drift(4)
        flat_loss(
            drift,  # type: ignore[arg-type]
            data,
            4,
            horizon_steps=8,
            trajectories=4,
            starts=3,
            generator=stream,
        )
        k = drift.seen[0][:, 1].reshape(4, 3)
        assert (k.diff(dim=1) > 0).all()  # three different frames, in order
        started |= set(k.flatten().tolist())
    assert started == set(range(0, 40, 4))


def test_gaps_lie_between_the_coarse_level_s_own_predictions() -> None:
    """All gaps of a rollout, each end with the error the rollout has gathered until there."""
    data, error = fake(20, 50), 0.125
    left, right, actions, (rows, a) = high_gaps(
        Drift(4, error),
        data,
        4,
        horizon_steps=12,
        trajectories=20,
        generator=np.random.default_rng(2),
    )
    assert len(left) == 20 * 3
    per_rollout = a.reshape(20, 3)
    assert torch.equal(per_rollout, per_rollout[:, :1] + torch.tensor([0, 4, 8]))
    assert len(set(per_rollout[:, 0].tolist())) > 5  # random starts
    walked = torch.arange(3.0).repeat(20)
    for ends, steps, gathered in ((left, 0, walked), (right, 4, walked + 1)):
        expected = torch.stack([rows + error * gathered, (a + steps).float()], dim=-1)
        torch.testing.assert_close(ends, expected)
    assert torch.equal(actions, a[:, None] + torch.arange(4.0))


def test_finer_levels_are_given_the_coarser_level_s_predictions_as_anchors() -> None:
    data, coarse_error, medium_error = fake(6, 50), 0.5, 0.25
    common = {"horizon_steps": 8, "trajectories": 6}

    def rollout_error(z: Tensor) -> Tensor:
        return z[:, 0] % 1.0  # trajectories are whole numbers

    medium = Drift(2, medium_error)
    medium_loss(
        medium,
        Drift(4, coarse_error),
        data,
        4,
        2,
        generator=np.random.default_rng(3),
        **common,  # type: ignore[arg-type]
    )
    assert rollout_error(medium.seen[0]).tolist() == [0.0, 0.5] * 6
    assert medium.waypoints[0] is not None
    assert rollout_error(medium.waypoints[0]).tolist() == [0.5, 0.0] * 6  # 2 × 0.5: a whole number
    low = Drift(1)
    low_loss(
        low,
        Drift(2, medium_error),
        Drift(4, coarse_error),
        data,
        4,
        2,
        1,
        generator=np.random.default_rng(3),
        **common,  # type: ignore[arg-type]
    )
    assert rollout_error(low.seen[0]).tolist() == [0.0, 0.25, 0.5, 0.75] * 6
    assert low.waypoints[0] is not None
    assert rollout_error(low.waypoints[0]).tolist() == [0.25, 0.5, 0.75, 0.0] * 6


# ---- windows ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("frames", "stride", "last"), [(5, 4, 7), (2, 1, 22), (6, 4, 3)])
def test_windows_start_anywhere_they_fit(frames: int, stride: int, last: int) -> None:
    k = window_indices(24, frames, stride, np.random.default_rng(4), 500)
    assert set(k[:, 0].tolist()) == set(range(last + 1))


def test_both_kinds_of_windows_start_anywhere() -> None:
    steps, stream = 24, np.random.default_rng(5)
    frames = torch.zeros(2, steps + 1, 1, 2, 3, dtype=torch.uint8)
    frames[:, :, 0, 0, 0] = torch.arange(steps + 1)
    data = fake(2, steps)
    images = FrameWindows(frames, data.actions, window_frames=5, stride=4, mirror=False)
    shown = images.draw(300, stream).frames.unflatten(0, (300, 5))[:, 0, 0, 0, 0, 0]
    _, k, _ = data.windows(300, 5, 4, stream)
    assert set(shown.tolist()) == set(k[:, 0].tolist()) == set(range(8))


# ---- optimiser, precision, actor -------------------------------------------------------------


def one_update(
    parameter: nn.Parameter, loss: Callable[[Tensor], Tensor], step: int, **changes: object
) -> float:
    options = {
        "name": "sgd",
        "schedule": "one-cycle",
        "steps": 101,
        "learning_rate": 0.5,
        "weight_decay": 0.0,
        "gradient_clip": 0.0,
    }
    before = parameter.item()
    Optimiser([parameter], **(options | changes)).step(loss(parameter), step)  # type: ignore
    return parameter.item() - before


@pytest.mark.parametrize("name", ["sgd", "adamw"])
def test_the_schedule_scales_the_updates(name: str) -> None:
    """With a gradient of one, both optimisers' first update is the learning rate itself."""
    expected = {0: 0.04, 15: 0.52, 30: 1.0, 65: 0.5, 100: 1e-4}  # 15 and 65 are half way
    for step, factor in expected.items():
        moved = one_update(nn.Parameter(torch.tensor(0.0)), lambda p: p.sum(), step, name=name)
        assert moved == pytest.approx(-0.5 * factor, rel=1e-3), step
    for step in (0, 65):
        parameter = nn.Parameter(torch.tensor(0.0))
        moved = one_update(parameter, lambda p: p.sum(), step, name=name, schedule="constant")
        assert moved == pytest.approx(-0.5, rel=1e-5)


@pytest.mark.parametrize("name", ["sgd", "adamw"])
def test_weights_decay_without_a_gradient(name: str) -> None:
    decayed = {
        decay: one_update(
            nn.Parameter(torch.tensor(2.0)),
            lambda p: 0.0 * p.sum(),
            0,
            name=name,
            schedule="constant",
            weight_decay=decay,
        )
        for decay in (0.0, 0.1)
    }
    assert decayed[0.0] == 0.0
    assert decayed[0.1] == pytest.approx(-0.5 * 0.1 * 2.0, rel=1e-5)  # − rate · decay · p


@pytest.mark.parametrize(("precision", "dtype"), [("bf16", torch.bfloat16), ("fp32", torch.float)])
def test_products_are_taken_in_the_precision_asked_for(precision: str, dtype: torch.dtype) -> None:
    a = torch.randn(4, 4)
    with autocast(CPU, precision):
        assert (a @ a).dtype == dtype
        assert predictor()(**inputs(), remaining=3).dtype == torch.float  # lengths stay exact
    assert (a @ a).dtype == torch.float

    class Probe(nn.Module):
        def forward(self, frames: Tensor) -> Tensor:
            assert (a @ a).dtype == dtype
            return frames.float().flatten(1)

    frames = torch.zeros(3, 2, 1, 2, 3, dtype=torch.uint8)
    z = encode_frames(Probe(), frames, device=CPU, precision=precision)
    assert z.dtype == torch.float and z.shape == (3, 12)


def test_the_fitted_actor_is_ready_for_use() -> None:
    options = dataclasses.replace(load_settings().actor, hidden=16, batch=32)
    z = torch.randn(64, 8)
    actor = fit_actor(z, z[:, 0].tanh(), options, seed=0, epochs=1)
    assert not actor.training
    assert torch.equal(actor(z), actor(z))
    with torch.no_grad():  # it was fitted with the dropout of the settings
        assert not torch.equal(actor.train()(z), actor(z))
