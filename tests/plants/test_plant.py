"""pymunk's cart-poles against equations written independently of the package."""

import dataclasses
import itertools

import numpy as np
import pytest

from hjepa_cli.compute.seeding import generator
from hjepa_cli.core.plants.cartpole.simulation import CartPoles
from hjepa_cli.core.plants.named import START, CartPole, plant, teacher
from hjepa_cli.errors import UsageError
from hjepa_cli.plugins import PLANTS

NAMES = ("desktop", "gym")
TRAINING_RANGES = {"desktop": (0.1, 0.5, 0.35, 5.0), "gym": (0.5, 0.5, 0.2, 0.5)}


def rate(kind, states, force_n):
    """Lagrange's equations in matrix form, M(θ) q̈ = f(θ, θ̇, u), solved as a linear system."""
    m, l = kind.pole_mass_kg, kind.half_length_m
    _, x_dot, theta, theta_dot = states.T
    coupling = m * l * np.cos(theta)
    mass = np.empty((len(states), 2, 2))
    mass[:, 0, 0] = kind.cart_mass_kg + m
    mass[:, 0, 1] = mass[:, 1, 0] = coupling
    mass[:, 1, 1] = m * l**2 + m * (2 * l) ** 2 / 12  # Steiner
    force = np.stack(
        [force_n + m * l * np.sin(theta) * theta_dot**2, m * 9.81 * l * np.sin(theta)], axis=-1
    )
    acceleration = np.linalg.solve(mass, force[..., None])[..., 0]
    return np.stack([x_dot, acceleration[:, 0], theta_dot, acceleration[:, 1]], axis=-1)


def exact_step(kind, states, force_n, parts=4):
    """Runge-Kutta at a quarter of the control step: exact to 1e-9 here."""
    h = kind.step_s / parts
    for _ in range(parts):
        a = rate(kind, states, force_n)
        b = rate(kind, states + h / 2 * a, force_n)
        c = rate(kind, states + h / 2 * b, force_n)
        d = rate(kind, states + h * c, force_n)
        states = states + h / 6 * (a + 2 * b + 2 * c + d)
    return states


def starts(name, devices, seed=0):
    return generator(seed).uniform(-1, 1, (devices, 4)) * TRAINING_RANGES[name]


def largest_errors(kind, initial, force_at, steps=100):
    """Largest error of each state when pymunk and the equations run side by side."""
    poles, exact = CartPoles(kind, len(initial)), initial
    poles.states = initial
    worst = np.zeros(4)
    for k in range(steps):
        ours, theirs = force_at(k, poles.states), force_at(k, exact)
        poles.step(ours)
        exact = exact_step(kind, exact, theirs)
        worst = np.maximum(worst, np.abs(poles.states - exact).max(axis=0))
    return worst


@pytest.mark.parametrize(("name", "bound"), [("desktop", 2e-5), ("gym", 1e-4)])
def test_follows_the_exact_equations_in_closed_loop(name, bound):
    drive = teacher(name)
    errors = largest_errors(PLANTS[name], starts(name, 100), lambda _, states: drive(states))
    assert errors.max() < bound


def test_follows_the_exact_equations_under_random_full_forces():
    forces_n = generator(1).uniform(-20, 20, (100, 100))
    errors = largest_errors(PLANTS["desktop"], starts("desktop", 100), lambda k, _: forces_n[k])
    assert errors.max() < 5e-5


@pytest.mark.parametrize("name", NAMES)
def test_error_falls_with_the_square_of_the_substep(name):
    drive = teacher(name)
    errors = [
        largest_errors(
            dataclasses.replace(PLANTS[name], substeps=substeps),
            starts(name, 20),
            lambda _, states: drive(states),
        )
        for substeps in (5, 10, 20)
    ]
    for coarse, fine in itertools.pairwise(errors):
        assert (coarse / fine > 3.5).all() and (coarse / fine < 4.5).all()


@pytest.mark.parametrize("name", NAMES)
def test_derivative_is_lagranges(name):
    states = generator(2).uniform(-1, 1, (200, 4)) * [1, 5, 4, 30]
    forces_n = generator(3).uniform(-20, 20, 200)
    ours = PLANTS[name].derivative(states, forces_n)
    np.testing.assert_allclose(ours, rate(PLANTS[name], states, forces_n), rtol=1e-11, atol=1e-10)
    stacked = PLANTS[name].derivative(states.reshape(4, 50, 4), forces_n.reshape(4, 50))
    np.testing.assert_array_equal(stacked.reshape(200, 4), ours)


def test_derivative_golden_values():
    """Gymnasium's geometry at g = 9.81, linearised by hand."""
    unit = np.eye(4) * 1e-6
    columns = PLANTS["gym"].derivative(unit, np.zeros(4)) / 1e-6
    assert columns[2] == pytest.approx([0, -0.717804878, 0, 15.7917073171], abs=1e-7)
    push = PLANTS["gym"].derivative(np.zeros(4), 1.0)
    assert push == pytest.approx([0, 0.9756097561, 0, -1.4634146341], abs=1e-9)


def test_rk4_is_of_fourth_order():
    start = np.array([[0.1, -0.3, 0.5, 2.0]])

    def advance(states, parts):
        shorter = dataclasses.replace(PLANTS["gym"], step_s=0.05 / parts)
        return shorter.advance(states, np.array([5.0]))

    exact = start
    for _ in range(64):
        exact = advance(exact, 64)

    def error(parts):
        states = start
        for _ in range(parts):
            states = advance(states, parts)
        return np.abs(states - exact).max()

    assert 12 < error(1) / error(2) < 20


def test_unstable_rates_and_data_rate_limits():
    assert plant("desktop").unstable_rate_rad_s == pytest.approx(9.169826295, abs=1e-9)
    assert plant("desktop").data_rate_limit_bits_per_s == pytest.approx(13.229262922, abs=1e-8)
    assert plant("gym").unstable_rate_rad_s == pytest.approx(3.973878120561, abs=1e-11)
    assert plant("gym").data_rate_limit_bits_per_s == pytest.approx(5.733094258, abs=1e-9)


def test_the_uncontrolled_pole_grows_at_its_unstable_rate():
    kind = PLANTS["desktop"]
    pole, growth = CartPole(kind), kind.unstable_rate_rad_s
    coupling = -kind.pole_mass_kg * kind.half_length_m / (kind.cart_mass_kg + kind.pole_mass_kg)
    direction = np.array([coupling, coupling * growth, 1, growth])  # the unstable eigenvector
    pole.state = 1e-6 * direction
    for _ in range(300):
        pole.step(0.0)
    np.testing.assert_allclose(pole.state / direction, 1e-6 * np.exp(growth * 0.3), rtol=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_free_fall_keeps_energy_and_momentum(name):
    kind = PLANTS[name]
    m, l = kind.pole_mass_kg, kind.half_length_m
    total = kind.cart_mass_kg + m

    def invariants(states):
        _, v, theta, w = states.T
        mixed = m * l * np.cos(theta)
        kinetic = total * v**2 / 2 + mixed * v * w + m * l**2 * 4 / 3 * w**2 / 2
        return kinetic + m * 9.81 * l * np.cos(theta), total * v + mixed * w

    poles = CartPoles(kind, 20)
    poles.states = starts(name, 20)
    energy, momentum = invariants(poles.states)
    for _ in range(round(2.0 / kind.step_s)):  # through the bottom and up again
        poles.step(np.zeros(20))
        now = invariants(poles.states)
        assert np.abs(now[0] - energy).max() < 1e-3 * 2 * m * 9.81 * l
        assert np.abs(now[1] - momentum).max() < 1e-3 * m * np.sqrt(9.81 * l)


@pytest.mark.parametrize("name", NAMES)
def test_a_state_that_is_set_is_read_back_and_the_joint_accepts_it(name):
    kind, devices = PLANTS[name], 100
    states = generator(4).uniform(-1, 1, (devices, 4)) * [50, 2, 50, 10]
    poles = CartPoles(kind, devices)
    poles.step(np.full(devices, 3.0))  # leaves impulses behind that must not leak over
    poles.states = states
    np.testing.assert_allclose(poles.states, states, rtol=0, atol=1e-13)
    poles.step(np.zeros(devices))
    change = np.abs(poles.states - exact_step(kind, states, np.zeros(devices)))
    assert change[:, [0, 2]].max() < 20e-3 * kind.step_s  # a wrong velocity moves it by metres/s
    assert change[:, [1, 3]].max() < 3e-2 * kind.step_s / 1e-3


def test_velocities_of_a_turning_pole_are_consistent():
    """Without the pivot's share in the centre's velocity the joint would stop the pole at once."""
    pole = CartPole("desktop")
    pole.state = [0.0, 0.3, 0.35, 5.0]
    after = pole.step(0.0)
    exact = exact_step(pole.plant, np.array([[0.0, 0.3, 0.35, 5.0]]), np.zeros(1))[0]
    np.testing.assert_allclose(after, exact, rtol=0, atol=2e-5)


def test_many_devices_are_as_many_single_ones():
    devices = 7
    scale = generator(5).uniform(0.8, 1.2, (devices, 2))
    initial, forces_n = starts("desktop", devices), generator(6).uniform(-20, 20, (200, devices))
    together = CartPoles(PLANTS["desktop"], devices, mass_scale=scale)
    together.states = initial
    for k in range(200):
        together.step(forces_n[k])
    for i in range(devices):
        alone = CartPoles(PLANTS["desktop"], 1, mass_scale=scale[i : i + 1])
        alone.states = initial[i : i + 1]
        for k in range(200):
            alone.step(forces_n[k, i : i + 1])
        np.testing.assert_array_equal(alone.states[0], together.states[i])


def test_mass_scale_scales_cart_and_pole():
    kind, scale = PLANTS["desktop"], np.array([[2.0, 1.0], [1.0, 3.0]])
    poles = CartPoles(kind, 2, mass_scale=scale)
    poles.states = initial = starts("desktop", 2)
    for _ in range(20):
        poles.step([4.0, 4.0])
    for i, (cart, pole) in enumerate(scale):
        scaled = dataclasses.replace(
            kind, cart_mass_kg=kind.cart_mass_kg * cart, pole_mass_kg=kind.pole_mass_kg * pole
        )
        single = CartPoles(scaled, 1)
        single.states = initial[i : i + 1]
        for _ in range(20):
            single.step([4.0])
        np.testing.assert_allclose(poles.states[i], single.states[0], rtol=0, atol=1e-12)


def test_reading_and_writing_at_every_step_changes_nothing_that_matters():
    """Noise is added that way, 0.03 rad/s a step. Also: pymunk once overran the buffers."""
    for devices in (1, 64):
        touched, untouched = (
            CartPoles(PLANTS["desktop"], devices),
            CartPoles(PLANTS["desktop"], devices),
        )
        touched.states = untouched.states = starts("desktop", devices)
        for _ in range(60):
            touched.states = touched.states
            for poles in (touched, untouched):
                poles.step(np.ones(devices))
        np.testing.assert_allclose(touched.states, untouched.states, rtol=0, atol=3e-4)


def test_forces_are_clipped_and_angles_are_not_wrapped():
    strong, limit = CartPole("desktop"), CartPole("desktop")
    for _ in range(20):
        strong.step(1000.0)
        limit.step(20.0)
    np.testing.assert_array_equal(strong.state, limit.state)
    spinning = CartPole("desktop")
    spinning.state = [0, 0, 0, 40.0]
    for _ in range(500):
        spinning.step(0.0)
    assert 15 < spinning.state[2] < 25


def test_noise_is_added_after_the_step_and_only_on_request():
    quiet, noisy, noise = CartPole("desktop"), CartPole("desktop"), np.array([0, 0.002, 0, 0.03])
    np.testing.assert_allclose(noisy.step(5.0, noise=noise), quiet.step(5.0) + noise, atol=1e-13)


def test_a_seed_fixes_the_start():
    first, again, other = (CartPole("desktop", seed=seed).state for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert (first != other).all() and (np.abs(first) <= START).all()
    assert not CartPole("desktop").state.any()


def test_two_simulations_are_bitwise_equal():
    def simulate():
        poles = CartPoles(PLANTS["gym"], 5)
        poles.states = starts("gym", 5)
        for k in range(100):
            poles.step(np.full(5, np.sin(k)))
        return poles.states

    np.testing.assert_array_equal(simulate(), simulate())


@pytest.mark.parametrize("build", [plant, CartPole])
def test_an_unknown_plant_names_the_choices(build):
    with pytest.raises(UsageError, match=r"moon.*desktop, gym"):
        build("moon")


def test_impossible_devices_are_refused():
    with pytest.raises(UsageError, match="devices = 0"):
        CartPoles(PLANTS["desktop"], 0)
    for scale in ([[1.0, 0.0]], [[1.0, np.nan]], [[1.0, 1.0], [1.0, 1.0]]):
        with pytest.raises(UsageError, match="mass_scale"):
            CartPoles(PLANTS["desktop"], 1, mass_scale=scale)
    with pytest.raises(ValueError, match="shape"):
        CartPoles(PLANTS["desktop"], 2).states = np.zeros(4)


def test_streams_are_named_and_independent():
    assert generator(0, 1, 2).random() == generator(0, 1, 2).random()
    draws = {generator(*key).random() for key in ((0,), (1,), (0, 0), (0, 1), (0, 0, 0), (0, 1, 0))}
    assert len(draws) == 6
