"""Methods in closed form: linear embeddings, identified dynamics, the Kalman filter."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.linalg import solve_discrete_are

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control import kalman, linear_latent
from hjepa_cli.core.control.embedded_split import EmbeddedSplit
from hjepa_cli.core.control.kalman import KalmanController, LinearGaussian, StateCodec, identify
from hjepa_cli.core.control.linear_latent import (
    LinearLatent,
    LinearPlanner,
    ridge_fits,
    rollout_error,
)
from hjepa_cli.core.control.loop import Draws, every_step, gap_schedule, simulate
from hjepa_cli.core.networks.symmetry import reflect
from hjepa_cli.core.plants.cartpole.simulation import CartPoles
from hjepa_cli.core.plants.named import plant, teacher

DESKTOP = plant("desktop")


def driven(
    a: np.ndarray, b: np.ndarray, c: np.ndarray, count: int = 40, steps: int = 30, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """States [N, T, S] of x' = A x + B u + c under random actions [N, T, F]."""
    random = np.random.default_rng(seed)
    actions = random.normal(size=(count, steps, b.shape[1]))
    states = [random.normal(size=(count, len(a)))]
    for k in range(steps - 1):
        states.append(states[-1] @ a.T + actions[:, k] @ b.T + c)
    return np.stack(states, axis=1), actions


def system(size: int, forces: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    a = np.linalg.qr(random.normal(size=(size, size)))[0] * 0.98
    return a, random.normal(size=(size, forces)), random.normal(size=size)


# ---- identification ------------------------------------------------------------------------------


def test_dynamics_of_linear_data_are_found_exactly() -> None:
    a, b, c = system(4, 2)
    found_a, found_b, found_c, unexplained = identify(*driven(a, b, c))
    assert found_a == pytest.approx(a, abs=1e-10)
    assert found_b == pytest.approx(b, abs=1e-10)
    assert found_c == pytest.approx(c, abs=1e-10)
    assert np.abs(unexplained).max() < 1e-20


def test_what_noise_leaves_unexplained_is_its_covariance() -> None:
    a, b, c = system(3, 1)
    mixing = np.array([[0.1, 0.0, 0.0], [0.05, 0.2, 0.0], [0.0, 0.1, 0.02]])
    random = np.random.default_rng(0)
    states, actions = driven(a, b, c, count=4000, steps=2)
    states[:, 1] += random.normal(size=(4000, 3)) @ mixing.T
    *_, unexplained = identify(states, actions)
    # Of 4000 samples: relative error about sqrt(2 / 4000) = 2 %.
    assert unexplained == pytest.approx(mixing @ mixing.T, abs=0.1 * np.abs(mixing).max() ** 2)


# ---- the filter ----------------------------------------------------------------------------------


def some_filter(size: int = 3) -> LinearGaussian:
    random = np.random.default_rng(3)
    a, b, c = system(size, 1)
    process, noise, start = (
        scale * (part @ part.T + np.eye(size))
        for scale, part in zip((0.02, 0.5, 2.0), random.normal(size=(3, size, size)), strict=True)
    )
    return LinearGaussian(a, b, c, process, noise, start)


def test_the_steady_state_solves_the_riccati_equation() -> None:
    model = some_filter()
    mean, spread = np.zeros((1, 3)), model.start[None]
    for _ in range(400):
        mean, spread = model.correct(mean, spread, np.zeros((1, 3)))
        mean, spread = model.predict(mean, spread, np.zeros((1, 1)))
    expected = solve_discrete_are(model.a.T, np.eye(3), model.process, model.noise)
    assert spread[0] == pytest.approx(expected, rel=1e-8)


def test_the_filter_is_weighted_least_squares_over_everything_seen() -> None:
    """The last state's posterior from one linear system of all states and measurements."""
    model = dataclasses.replace(some_filter(), c=np.array([0.1, -0.2, 0.3]))
    random = np.random.default_rng(5)
    steps, size = 6, 3
    actions, seen = random.normal(size=(steps, 1)), random.normal(size=(steps, size))
    arrives = [True, False, True, False, False, True]
    mean, spread = np.zeros((2, size)), np.tile(model.start, (2, 1, 1))
    for k in range(steps):
        if arrives[k]:
            mean, spread = model.correct(mean, spread, np.tile(seen[k], (2, 1)))
        if k < steps - 1:
            mean, spread = model.predict(mean, spread, np.tile(actions[k], (2, 1)))
    # Unknowns x_0 … x_5; rows: prior, dynamics, measurements, each whitened.
    rows, values, eye = [], [], np.eye(size)

    def add(blocks: dict[int, np.ndarray], value: np.ndarray, covariance: np.ndarray) -> None:
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        row = np.zeros((size, steps * size))
        for k, block in blocks.items():
            row[:, k * size : (k + 1) * size] = block
        rows.append(whiten @ row)
        values.append(whiten @ value)

    add({0: eye}, np.zeros(size), model.start)
    for k in range(steps - 1):
        add({k: -model.a, k + 1: eye}, model.b @ actions[k] + model.c, model.process)
    for k in range(steps):
        if arrives[k]:
            add({k: eye}, seen[k], model.noise)
    design = np.concatenate(rows)
    solution = np.linalg.lstsq(design, np.concatenate(values), rcond=None)[0]
    covariance = np.linalg.inv(design.T @ design)[-size:, -size:]
    assert mean == pytest.approx(np.tile(solution[-size:], (2, 1)), rel=1e-9)
    assert spread[1] == pytest.approx(covariance, rel=1e-8)


def test_the_controller_knows_what_the_actuator_played() -> None:
    """Forces are clipped before the filter counts with them; others' packets change nothing."""
    model = LinearGaussian(
        np.eye(2), np.ones((2, 1)), np.zeros(2), *[1e-9 * np.eye(2)] * 2, np.eye(2)
    )
    played = KalmanController(model, np.asarray, lambda x: -100.0 * x[..., 0], 20.0, 2)
    both, one = np.array([True, True]), np.array([False, True])
    assert played.act(both, np.array([[1.0, 0.0], [-1.0, 0.0]])) == pytest.approx([-20, 20])
    # Actions of ∓1 moved the estimates from ±1 to 0.
    assert played.planned_n() == pytest.approx([0.0, 0.0], abs=1e-6)
    forces_n = played.act(one, np.array([[0.1, 0.0]]))
    assert forces_n[0] == pytest.approx(0.0, abs=1e-6) and forces_n[1] < -1.0


def test_with_exact_states_the_filter_is_the_teacher() -> None:
    draws = Draws.make(
        dataclasses.replace(load_settings(flags={"protocol": "paper"}).protocol, steps=60),
        4,
        seed=1,
    )
    eye = np.eye(4)
    model = LinearGaussian(eye, np.zeros((4, 1)), np.zeros(4), 1e3 * eye, 1e-12 * eye, eye)
    controller = KalmanController(model, np.asarray, teacher("desktop"), 20.0, 4)
    states_of = simulate(
        DESKTOP, draws, every_step(60, 4)[None], controller, lambda seen: seen[:, -1]
    )
    poles = CartPoles(DESKTOP, 4)
    poles.states = draws.initial
    poles.step(np.zeros(4))
    cost = np.zeros(4)
    for k in range(60):
        forces_n = teacher("desktop")(poles.states)
        cost += DESKTOP.cost(poles.states, forces_n)
        poles.step(forces_n)
        poles.states = poles.states + draws.noise[k]
    assert states_of.cost[0] == pytest.approx(cost / 60, rel=1e-6)


def test_states_are_sent_in_twelve_bits_each() -> None:
    codec = StateCodec(np.array([0.2, 1.0, 0.5, 8.0]))
    assert codec.bits == 48
    states = np.random.default_rng(0).uniform(-1, 1, (5000, 4)) * codec.reach
    received = codec.send(states)
    assert (np.abs(received - states) <= codec.step / 2 + 1e-15).all()
    assert all(len(np.unique(column)) <= 4096 for column in received.T)
    assert codec.step == pytest.approx(2 * codec.reach / 4096)
    beyond = codec.send(np.array([[9.0, -9.0, 0.0, 0.0]]))[0]
    assert np.abs(beyond[:2]) == pytest.approx(codec.reach[:2] - codec.step[:2] / 2)


# ---- linear embeddings ---------------------------------------------------------------------------


def linear_split(count: int = 60, seed: int = 0) -> EmbeddedSplit:
    """Eight-dimensional embeddings that really move linearly, and equally on both sides."""
    a, b = np.zeros((8, 8)), np.zeros((8, 1))
    a[:4, :4], a[4:, 4:] = system(4, 1, 2)[0], system(4, 1, 3)[0]
    b[4:] = system(4, 1, 4)[1]
    c = np.concatenate([np.full(4, 0.1), np.zeros(4)])
    z, actions = driven(a, b, c, count, seed=seed)
    return EmbeddedSplit(torch.from_numpy(z).float(), np.zeros((count, 30, 4)), actions)


def test_linear_embeddings_are_found_and_rolled_out() -> None:
    train, test = linear_split(), linear_split(10, seed=9)
    for signs in (None, (-1.0,)):
        fits = ridge_fits(train, signs)
        best = fits[0]
        z, actions = test.z[:, 0].double(), torch.from_numpy(test.actions)
        for k in range(20):
            z = best.step(z, actions[:, k])
        torch.testing.assert_close(z.float(), test.z[:, 20], atol=1e-3, rtol=0)
        errors = [rollout_error(fit, test) for fit in fits]
        assert errors[0] < 1e-3 < errors[-1] and np.argmin(errors) < 4


def test_mirror_images_make_the_fit_symmetric() -> None:
    torch.manual_seed(0)
    data = dataclasses.replace(linear_split(4), z=linear_split(4).z + 0.1 * torch.randn(4, 30, 8))
    z, actions = torch.randn(5, 8).double(), torch.randn(5, 1).double()
    plain, symmetric = (ridge_fits(data, signs)[2] for signs in (None, (-1.0,)))
    mirrored = symmetric.step(reflect(z), -actions)
    torch.testing.assert_close(mirrored, reflect(symmetric.step(z, actions)), atol=1e-9, rtol=0)
    assert (plain.step(reflect(z), -actions) - reflect(plain.step(z, actions))).abs().max() > 1e-3


def test_ridge_by_its_normal_equations() -> None:
    data = linear_split(3)
    inputs = torch.cat(
        [data.z[:, :-1].double(), torch.from_numpy(data.actions[:, :-1]), torch.ones(3, 29, 1)],
        dim=2,
    ).flatten(0, 1)
    change = (data.z[:, 1:].double() - data.z[:, :-1].double()).flatten(0, 1)
    gram = inputs.T @ inputs
    fit = ridge_fits(data, None)[-1]
    penalty = fit.ridge * gram.diagonal().mean() * torch.eye(10)
    expected = torch.linalg.solve(gram + penalty, inputs.T @ change)
    torch.testing.assert_close(fit.weights, expected, atol=1e-8, rtol=0)


def test_the_held_out_trajectories_choose_the_ridge(monkeypatch: pytest.MonkeyPatch) -> None:
    noisy, random = linear_split(1), torch.Generator().manual_seed(0)
    noisy = dataclasses.replace(noisy, z=noisy.z + 3 * torch.randn(1, 30, 8, generator=random))
    splits = {"train": noisy, "test": linear_split(10, seed=9)}
    monkeypatch.setattr(linear_latent, "embed_split", lambda model, settings, split: splits[split])
    model = SimpleNamespace(plant=DESKTOP, architecture={"mirror": "none"}, device="cpu")
    chosen = linear_latent.fit_linear_latent(model, load_settings())
    errors = {fit.ridge: rollout_error(fit, splits["test"]) for fit in ridge_fits(noisy, None)}
    assert chosen.ridge == min(errors, key=errors.__getitem__) == 0.01


def test_the_planner_shows_the_actor_embeddings_of_their_length() -> None:
    seen = []

    def actor(z: torch.Tensor) -> torch.Tensor:
        seen.append(z)
        return 10.0 * z[:, 0]

    latent = LinearLatent(torch.zeros(6, 4), 0.0)
    latent.weights[4, 1] = 3.0  # a full action adds 3 to the second value
    forces_n, ahead = LinearPlanner(latent, actor, 20.0).plan(torch.tensor([[1.0, 0.0, 0.0, 0.0]]))
    assert forces_n.tolist() == [[20.0]]
    assert ahead.tolist() == [[1.0, 3.0, 0.0, 0.0]]
    assert seen[0].tolist() == [[2.0, 0.0, 0.0, 0.0]]


# ---- fitted to a model ---------------------------------------------------------------------------


def test_a_reader_of_linear_embeddings_controls_as_well_as_the_teacher(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Embeddings that are the state in other coordinates: decoder, dynamics and filter are good."""
    few = {"collect.trajectories": 40, "collect.test_trajectories": 10, "collect.steps": 100}
    settings = load_settings(flags=few | {"control.gains_n": []})
    mix = torch.randn(4, 12, generator=torch.Generator().manual_seed(0))

    def embed(model: object, seen: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.asarray(seen[:, -1], np.float32)) @ mix

    monkeypatch.setattr("hjepa_cli.core.control.embedded_split.embed_states", embed)

    class Blind:
        plant, look = DESKTOP, (2, 1)

    model = Blind()
    reader = kalman.fit_state_reader(model, settings)
    states = 0.05 * np.random.default_rng(0).normal(size=(6, 1, 4))
    assert reader.read(embed(model, states)) == pytest.approx(states[:, 0], abs=1e-3)
    draws = Draws.make(dataclasses.replace(settings.protocol, warmup_steps=0, steps=200), 6, seed=2)
    outcomes = {}
    for gap in (1.0, 20.0):
        controls = KalmanController(reader.filter, reader.read, teacher("desktop"), 20.0, 6)
        schedule = gap_schedule(gap, 200, 6)[None]
        sense = lambda seen: embed(model, seen)  # noqa: E731
        outcomes[gap] = simulate(DESKTOP, draws, schedule, controls, sense).score.mean()
    assert outcomes[1.0] > 0.8 and outcomes[20.0] > 0.7
    # A link that adds noise of 0.1 to embeddings: the filter is told what that is in states.
    noise = 0.1 * torch.randn(10_000, 12, generator=torch.Generator().manual_seed(1))
    told = kalman.fit_state_reader(model, settings, lambda z: z + noise[: len(z)])
    unmixed = np.linalg.pinv(mix.numpy().astype(float))
    expected = 0.01 * unmixed.T @ unmixed
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert told.filter.noise / scale == pytest.approx(expected / scale, abs=0.15)


def test_a_filter_that_hears_nothing_for_long_can_be_corrected_again() -> None:
    """The covariance of an unstable plant grows without end; after 3,000 steps it still inverts."""
    grow = np.array([[1.01, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1.02, 0.1], [0.01, 0, 0.1, 1]])
    filter_ = kalman.LinearGaussian(
        a=grow,
        b=np.zeros((4, 1)),
        c=np.zeros(4),
        process=1e-6 * np.eye(4),
        noise=1e-6 * np.eye(4),
        start=1e-4 * np.eye(4),
    )
    controls = KalmanController(filter_, np.asarray, teacher("desktop"), 20.0, 2)
    silent, both = np.zeros(2, dtype=bool), np.ones(2, dtype=bool)
    for _ in range(3000):
        controls.act(silent, None)
    seen = np.array([[0.01, 0.0, 0.02, 0.0], [0.0, 0.1, -0.03, 0.2]])
    for _ in range(20):  # a device that stands still: the filter, which thinks it moves, follows
        forces_n = controls.act(both, seen)
    assert np.isfinite(forces_n).all()
    assert np.sign(forces_n).tolist() == np.sign(teacher("desktop")(seen)).tolist()
