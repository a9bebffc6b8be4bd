"""The teacher against scipy's Riccati solvers and published gains."""

import dataclasses

import numpy as np
import pytest
import scipy.linalg

from hjepa_cli.compute.seeding import generator
from hjepa_cli.core.plants.cartpole import teacher as policy
from hjepa_cli.core.plants.cartpole.teacher import gains, state_dependent_form
from hjepa_cli.core.plants.named import teacher
from hjepa_cli.errors import UsageError
from hjepa_cli.plugins import PLANTS

NAMES = ("desktop", "gym")
WHOLE_TABLE = np.array([0.1, 0.5, 1.2, 25.0])
TRAINING = {"desktop": np.array([0.1, 0.5, 0.35, 5.0]), "gym": np.array([0.5, 0.5, 0.2, 0.5])}


def scipy_gain(kind, a, b):
    q, r = np.diag(kind.state_weights), np.array([[kind.force_weight]])
    if kind.discrete_teacher:
        block = scipy.linalg.expm(np.block([[a, b], [np.zeros((1, 5))]]) * kind.step_s)
        a, b, q, r = block[:4, :4], block[:4, 4:], q * kind.step_s, r * kind.step_s
        p = scipy.linalg.solve_discrete_are(a, b, q, r)
        return np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)[0]
    return (np.linalg.inv(r) @ b.T @ scipy.linalg.solve_continuous_are(a, b, q, r))[0]


def linear_gain(kind):
    """Of the linear quadratic regulator at the origin [4]."""
    return gains(kind, np.zeros(1), np.zeros(1)).reshape(4)


def draws(scale, count=400, seed=0):
    return generator(seed).uniform(-1, 1, (count, 4)) * scale


def test_golden_gains():
    assert linear_gain(PLANTS["desktop"]) == pytest.approx([-20.0, -11.8, -34.9, -3.4], abs=0.06)
    golden = [-8.5653249345, -10.4832067011, -69.5234372720, -16.7105673629]
    assert linear_gain(PLANTS["gym"]) == pytest.approx(golden, abs=1e-8)
    continuous = dataclasses.replace(PLANTS["gym"], discrete_teacher=False)
    golden = [-10, -12.1339528372, -78.1036940184, -18.6758522499]
    assert linear_gain(continuous) == pytest.approx(golden, abs=1e-8)
    fast = dataclasses.replace(PLANTS["gym"], step_s=1e-3)
    golden = [-9.9228367628, -12.0452975839, -77.6435102946, -18.5706207631]
    assert linear_gain(fast) == pytest.approx(golden, abs=1e-8)


@pytest.mark.parametrize("name", NAMES)
def test_gains_are_scipys(name):
    kind, states = PLANTS[name], draws(WHOLE_TABLE, 60)
    states[0] = 0.0  # the origin: the linear quadratic regulator
    a, b = state_dependent_form(kind, states[:, 2], states[:, 3])
    ours = gains(kind, states[:, 2], states[:, 3])
    for i in range(len(states)):
        np.testing.assert_allclose(ours[i], scipy_gain(kind, a[i], b[i]), rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_the_table_at_the_origin_is_the_linear_regulator(name):
    states = draws([1e-3, 1e-3, 1e-6, 1e-6])
    linear = -states @ linear_gain(PLANTS[name])
    np.testing.assert_allclose(teacher(name)(states), linear, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_the_factorisation_is_exact(name):
    kind, states = PLANTS[name], draws([1, 2, 3, 25])
    forces_n = generator(1).uniform(-20, 20, len(states))
    a, b = state_dependent_form(kind, states[:, 2], states[:, 3])
    product = (a @ states[..., None])[..., 0] + b[..., 0] * forces_n[:, None]
    np.testing.assert_allclose(product, kind.derivative(states, forces_n), rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", NAMES)
def test_interpolation_between_the_nodes(name):
    """Against a solution at the very state: 0.05 % of ± 20 N where data lie, 0.25 % anywhere."""
    kind = PLANTS[name]
    for scale, bound_n in ((TRAINING[name], 0.01), (WHOLE_TABLE, 0.05)):
        states = draws(scale, 3000)
        solved = -np.sum(gains(kind, states[:, 2], states[:, 3]) * states, axis=1)
        error_n = np.abs(teacher(name)(states) - solved.clip(-20, 20))
        assert error_n.max() < bound_n


@pytest.mark.parametrize("name", NAMES)
def test_mirrored_states_get_mirrored_forces(name):
    states = draws([1, 2, 3, 40])
    drive = teacher(name)
    np.testing.assert_allclose(drive(-states), -drive(states), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_forces_are_saturated_and_gains_clamped_beyond_the_table(name):
    drive = teacher(name)
    assert drive(draws([5, 5, 5, 50])).max() == 20.0 == -drive(draws([5, 5, 5, 50])).min()
    free = teacher(dataclasses.replace(PLANTS[name], force_limit_n=1e6))
    edge = gains(PLANTS[name], np.array([1.2]), np.array([25.0]))[0]
    beyond = np.array([0.1, 0.2, 7.0, 60.0])
    assert free(beyond) == pytest.approx(-edge @ beyond, rel=1e-9)


def test_leading_axes_and_batches_change_nothing():
    drive, states = teacher("desktop"), draws([0.2, 1, 1.5, 30], 24)
    forces_n = drive(states)
    assert forces_n.shape == (24,)
    np.testing.assert_array_equal(drive(states.reshape(2, 3, 4, 4)), forces_n.reshape(2, 3, 4))
    np.testing.assert_array_equal([drive(state) for state in states], forces_n)
    assert np.shape(drive(states[0])) == () and drive(states[:0]).shape == (0,)


def test_the_teacher_is_made_once_per_plant():
    assert teacher("desktop") is teacher(PLANTS["desktop"]) is not teacher("gym")


def test_an_unknown_plant_names_the_choices():
    with pytest.raises(UsageError, match=r"moon.*desktop, gym"):
        teacher("moon")


def test_golden_costs_from_rest():
    """Gymnasium's plant, continuous gains held for 20 ms, 4 s: values of another program."""
    kind = dataclasses.replace(PLANTS["gym"], discrete_teacher=False)
    drive, states, cost, parts = teacher(kind), np.zeros((3, 4)), np.zeros(3), 10
    fine = dataclasses.replace(kind, step_s=kind.step_s / parts)
    states[:, 2] = 0.2, 0.35, 0.6

    def running_cost():
        return states**2 @ kind.state_weights + kind.force_weight * force_n**2

    for _ in range(200):
        force_n = drive(states)
        for _ in range(parts):
            cost += running_cost() * kind.step_s / parts / 2
            states = fine.advance(states, force_n)
            cost += running_cost() * kind.step_s / parts / 2
    assert cost == pytest.approx([0.31775, 1.06207, 4.5044], rel=1e-3)
    assert np.abs(states).max() < 0.02


def test_table_has_a_node_at_the_origin():
    assert policy.CELLS[0] % 2 == policy.CELLS[1] % 2 == 0
