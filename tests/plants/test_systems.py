"""What every plant must be, and the planar quadrotor against independent physics."""

import re
import subprocess
import sys
import tomllib

import numpy as np
import pytest
import scipy.integrate
import scipy.signal
from command_line import ENVIRONMENT, ROOT, open_shell

from hjepa_cli.config.schema import RECORDED
from hjepa_cli.config.settings import PRESETS, load_settings
from hjepa_cli.core.control.loop import Draws, every_step, simulate
from hjepa_cli.core.control.methods.true_state import true_state_driver
from hjepa_cli.core.plants.cost import COST_CAP
from hjepa_cli.core.plants.drawing import Rod, draw
from hjepa_cli.core.plants.linear import linearise, lqr_gain
from hjepa_cli.core.plants.named import Camera, CartPole, plant, plant_of
from hjepa_cli.core.plants.system import System
from hjepa_cli.errors import UsageError
from hjepa_cli.plugins import PLANTS
from hjepa_cli.storage.runs import to_toml

NAMES = [name for name in PLANTS if name != RECORDED]  # which has no equations
QUADROTOR = plant("quadrotor")

TINY = """
[collect]
trajectories = 6
test_trajectories = 4
clean_trajectories = 2
steps = 24
clean_steps = 24
[encoder]
steps = 2
gate = false
batch_trajectories = 2
batch_frames = 4
[augment]
steps = 2
[actor]
epochs = 1
[hierarchy]
rollout_steps = 8
batch_trajectories = 2
coarse_steps = 2
flat_steps = 2
medium_steps = 2
low_steps = 2
[protocol]
warmup_steps = 0
steps = 20
curve_devices = 2
bracket_devices = 2
gaps = [1, 5]
bracket = 0.5
bootstrap = 20
horizon = 20
"""


def settings_of(name):
    return load_settings(name if name in PRESETS else None)


def some(system, count, seed=0):
    """States [count, S] within the training ranges and forces [count, *A] within the limit."""
    random = np.random.default_rng(seed)
    half_widths = np.array(settings_of(system.name).collect.half_widths)
    states = random.uniform(-1, 1, (count, half_widths.size)) * half_widths
    forces_n = random.uniform(-1, 1, (count, *system.action_shape)) * system.force_limit_n
    return states, forces_n


@pytest.mark.parametrize("name", NAMES)
def test_a_system_keeps_its_promises(name):
    system, settings = plant(name), settings_of(name)
    assert plant_of(settings) is system and system.name == name
    states, forces_n = some(system, 6)
    moved = system.advance(states, forces_n)
    assert moved.shape == states.shape and system.in_band(states).shape == (6,)
    assert system.cost(states, forces_n).shape == (6,)
    assert system.cost(1e6 + states, forces_n).tolist() == [COST_CAP] * 6
    act = system.teacher()
    assert act(states.reshape(2, 3, -1)).shape == (2, 3, *system.action_shape)
    assert np.abs(act(10 * states)).max() <= system.force_limit_n
    np.testing.assert_array_equal(act(states)[2:3], act(states[2:3]))  # whatever the batch
    assert (act(np.zeros_like(states)) == 0).all() and system.in_band(np.zeros_like(states)).all()

    def step(forces_n):
        world = system.simulation(6)
        world.states = states
        world.step(forces_n)
        return world.states

    np.testing.assert_allclose(step(forces_n), moved, rtol=2e-3, atol=2e-4)  # pymunk is 2nd order
    limit_n = system.force_limit_n
    np.testing.assert_array_equal(
        step(10 * forces_n), step((10 * forces_n).clip(-limit_n, limit_n))
    )
    with pytest.raises(UsageError, match="at least 1"):
        system.simulation(0)
    with pytest.raises(ValueError, match="shape"):
        system.simulation(6).states = states[:, :-1]


@pytest.mark.parametrize("name", NAMES)
def test_the_mirror_is_exact_physics(name):
    """What training relies on: the mirrored pictures are those of a plant driven by ``mirror``."""
    system = plant(name)
    states, forces_n = some(system, 20)
    sign = np.array(
        [-1.0 if state.startswith(("x", "theta")) else 1.0 for state in system.state_names]
    )
    mirrored = system.advance(states * sign, forces_n * np.array(system.mirror))
    np.testing.assert_allclose(mirrored, system.advance(states, forces_n) * sign, atol=1e-12)
    np.testing.assert_allclose(
        system.teacher()(states * sign),
        system.teacher()(states) * np.array(system.mirror),
        atol=1e-9,
    )
    frames, seen = system.camera().render(states), system.camera().render(states * sign)
    assert np.abs(frames[:, :, ::-1].astype(int) - seen).max() <= 1


@pytest.mark.parametrize("name", NAMES)
def test_sideways_is_where_the_moved_picture_was_taken(name):
    system, camera = plant(name), plant(name).camera()
    states = some(system, 6)[0]
    shifts_px = np.array([3, -2, 0, 1, 5, -4])
    moved = camera.render(system.sideways(states, shifts_px))
    for frame, shift_px, there in zip(camera.render(states), shifts_px, moved, strict=True):
        inside = slice(max(shift_px, 0), 128 + min(shift_px, 0))
        shifted = np.roll(frame, shift_px, axis=1)
        assert np.abs(shifted[:, inside].astype(int) - there[:, inside]).max() <= 1
    with pytest.raises(UsageError, match=f"plant {name} does not say what moving its picture"):
        System.sideways(system, states, shifts_px)


@pytest.mark.parametrize("name", NAMES)
def test_the_camera_sees_the_slowest_motion(name):
    """A hundredth of the training range in any position changes the picture, and only positions."""
    system, camera = plant(name), plant(name).camera()
    assert camera.manifest()["version"] >= 1
    half_widths = np.array(settings_of(name).collect.half_widths)
    (still,) = camera.render(np.zeros((1, half_widths.size)))
    assert still.shape == (64, 128, 3) and still.dtype == np.uint8 and still.min() < 128
    for index, state in enumerate(system.state_names):
        nudge = np.zeros((1, half_widths.size))
        nudge[0, index] = half_widths[index] / 100
        assert (camera.render(nudge)[0] != still).any() != state.endswith("_dot"), state


@pytest.mark.parametrize("name", NAMES)
def test_the_sketch_lies_on_the_picture(name):
    system = plant(name)
    states, _ = some(system, 5)
    for state, frame in zip(states, system.camera().render(states), strict=True):
        axis = system.camera().sketch_px(state)[0]
        for share in (0.1, 0.9):  # of the axis; between the quadrotor's rotors is a gap
            column, row = axis[0] + share * (axis[1] - axis[0])
            near = frame[int(row) - 1 : int(row) + 2, int(column) - 1 : int(column) + 2]
            assert (near.min(axis=(0, 1)) < 200).any(), (state, share)


@pytest.mark.parametrize("name", NAMES)
def test_a_protocol_judges_methods_not_the_plant(name):
    """The teacher scores about 0.85 or more on the shipped protocol; holding a force does not."""
    system, protocol = plant(name), settings_of(name).protocol
    draws = Draws.make(protocol, 24, 0)

    def score(method, every):
        how = true_state_driver(method, system, 1)
        schedule = every_step(draws.steps, 24)
        schedule[np.arange(draws.steps) % every > 0] = False
        return simulate(system, draws, schedule[None], how.controller(24), how.sensor).score.mean()

    assert score("optimal", 1) >= 0.82  # 24 devices: 0.03 is two standard errors
    assert score("hold-true", 80) < 0.62 < score("oracle", 40 if system.step_s < 0.02 else 15)


@pytest.mark.parametrize("name", ("desktop", "gym"))
def test_the_rate_from_the_equations_is_the_closed_form(name):
    closed_form = PLANTS[name].unstable_rate_rad_s
    from_equations = super(type(PLANTS[name]), PLANTS[name]).unstable_rate_rad_s
    assert from_equations == pytest.approx(closed_form, rel=1e-6)


def test_the_quadrotors_rate_is_that_of_its_characteristic_polynomial():
    """θ̈ = −k (ẋ + h θ̇), ẍ = g θ − d (ẋ + h θ̇): s³ + (d + k h) s² + g k = 0 (and s = 0)."""
    kind = QUADROTOR
    d, k = kind.drag_kg_s / kind.mass_kg, kind.hub_m * kind.drag_kg_s / kind.inertia_kg_m2
    roots = np.roots([1, d + k * kind.hub_m, 0, kind.gravity_m_s2 * k])
    unstable = roots.real[roots.real > 0].sum()
    assert kind.unstable_rate_rad_s == pytest.approx(unstable, rel=1e-4)
    assert kind.data_rate_limit_bits_per_s == pytest.approx(unstable / np.log(2), rel=1e-4)


def test_a_step_of_the_quadrotor_against_newton_and_scipy():
    """Forces and torques written down as vectors, integrated by scipy at 1e-12."""
    kind = QUADROTOR
    states, forces_n = some(kind, 8)

    def rate(_, state, lift, turn):
        velocity, angle, spin = state[[1, 3]], state[4], state[5]
        right = np.array([np.cos(angle), -np.sin(angle)])
        up = np.array([np.sin(angle), np.cos(angle)])
        hub = kind.hub_m * up
        hub_velocity = velocity + spin * np.array([hub[1], -hub[0]])  # turning clockwise
        drag = -kind.drag_kg_s * (hub_velocity @ right) * right
        push = (lift + kind.mass_kg * kind.gravity_m_s2) * up
        weight = np.array([0, -kind.mass_kg * kind.gravity_m_s2])
        acceleration = (drag + push + weight) / kind.mass_kg
        torque = hub[1] * drag[0] - hub[0] * drag[1] + kind.arm_m * turn
        return np.array([velocity[0], acceleration[0], velocity[1], acceleration[1], spin,
                         torque / kind.inertia_kg_m2])  # fmt: skip

    for state, forces, ours in zip(states, forces_n, kind.advance(states, forces_n), strict=True):
        exact = scipy.integrate.solve_ivp(
            rate, (0, kind.step_s), state, args=tuple(forces), rtol=1e-12, atol=1e-12
        ).y[:, -1]
        np.testing.assert_allclose(ours, exact, atol=1e-7)


def test_masses_of_devices_differ():
    heavy = QUADROTOR.simulation(2, mass_scale=[[1, 1], [2, 1]])
    heavy.step(np.zeros((2, 2)))  # thrust for the nominal weight: the heavy one falls at g / 2
    assert heavy.states[:, 3] == pytest.approx([0, -9.81 / 2 * QUADROTOR.step_s], abs=1e-12)
    turning = QUADROTOR.simulation(2, mass_scale=[[1, 1], [1, 2]])
    turning.step([[0, 0.1], [0, 0.1]])
    assert turning.states[0, 5] == pytest.approx(2 * turning.states[1, 5], rel=2e-2)


def test_the_regulator_is_the_one_of_least_cost():
    """Against a long backward Riccati recursion, written down anew."""
    kind = QUADROTOR
    a, b = linearise(kind.advance, np.zeros(6), np.zeros(2))
    q, r = np.diag(kind.state_weights), np.diag(kind.force_weights)
    p = q
    for _ in range(20_000):
        gain = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
        p = q + a.T @ p @ (a - b @ gain)
    np.testing.assert_allclose(
        lqr_gain(a, b, kind.state_weights, kind.force_weights), gain, rtol=1e-6, atol=1e-8
    )
    small = 1e-3 * np.eye(6)
    np.testing.assert_allclose(kind.teacher()(small), -small @ gain.T, rtol=1e-6, atol=1e-10)


def test_linearise_finds_the_matrices_of_a_linear_step():
    random = np.random.default_rng(0)
    a, b = random.normal(size=(3, 3)), random.normal(size=(3, 2))
    found = linearise(lambda x, u: x @ a.T + u @ b.T, np.zeros(3), np.zeros(2))
    np.testing.assert_allclose(found[0], a, atol=1e-9)
    np.testing.assert_allclose(found[1], b, atol=1e-9)
    _, single = linearise(lambda x, u: x + u[:, None], np.zeros(3), np.zeros(()))
    assert single.shape == (3, 1)


def test_a_rod_covers_its_area_and_its_place():
    """Ends at (30.3, 20.6) and (70.3, 20.6), 4 px thick: 40 × 4 and two half discs."""
    start, end = np.array([[30.3, 20.6]]), np.array([[70.3, 20.6]])
    (frame,) = draw([Rod(start, end, 4.0, (0, 0, 0))])
    share = 1 - frame[..., 0] / 255.0
    assert share.sum() == pytest.approx(160 + np.pi * 4, rel=0.01)
    rows, columns = np.mgrid[:64, :128] + 0.5
    assert (share * columns).sum() / share.sum() == pytest.approx(50.3, abs=0.02)
    assert (share * rows).sum() / share.sum() == pytest.approx(20.6, abs=0.02)
    outside = draw([Rod(start - 500, end - 500, 4.0, (0, 0, 0))])
    assert (outside == 255).all()


def test_rods_do_not_depend_on_the_batch():
    random = np.random.default_rng(1)
    start, end = random.uniform(-20, 140, (40, 2)), random.uniform(-20, 140, (40, 2))
    together = draw([Rod(start, end, 3.0, (0, 9, 99))])
    alone = [draw([Rod(start[i : i + 1], end[i : i + 1], 3.0, (0, 9, 99))])[0] for i in range(40)]
    np.testing.assert_array_equal(together, np.stack(alone))


def test_what_does_not_fit_is_said():
    with pytest.raises(UsageError, match="no cart-pole; choose one of desktop, gym"):
        CartPole("quadrotor")
    with pytest.raises(UsageError, match="no cart-pole"):
        Camera("quadrotor")
    with pytest.raises(UsageError, match="'moon'; choose from desktop, gym, quadrotor"):
        plant("moon")
    with pytest.raises(UsageError, match="has 4 values; plant quadrotor has 6 states: x, x_dot"):
        plant_of(load_settings("quadrotor", flags={"encoder.gate_r2": [1.0] * 4}))
    with pytest.raises(UsageError, match=r"start has 3 values; plant desktop has 4 states"):
        plant_of(load_settings(flags={"collect.start": [0.1, 0.2, 0.3]}))


def test_settings_of_cart_poles_are_what_they_were():
    """Digests of curves, datasets and checkpoints depend on these keys."""
    values = load_settings().as_dict()
    assert not {"start", "noise", "gate_r2"} & {
        key for part in ("collect", "encoder", "protocol") for key in values[part]
    }
    assert load_settings("quadrotor").as_dict()["protocol"]["noise"][1] == 0.005


def test_two_forces_through_all_five_stages(tmp_path, monkeypatch, capsys):
    shell = open_shell(tmp_path, monkeypatch, capsys)
    (tmp_path / "tiny.toml").write_text(TINY)
    run = ("--preset", "quadrotor", "--config", "tiny.toml")
    outcome = shell(
        "reproduce", *run, "--methods", "hjepa,ts-jepa-1,hold,zero,oracle", "--out", "r", "--json"
    )
    assert outcome.code == 0, outcome.err
    results = outcome.document
    assert list(results["train-encoder"]["health"]["probe_r2"]) == list(QUADROTOR.state_names)
    assert set(results["eval"]["methods"]) == {"hjepa", "ts-jepa-1", "hold", "zero", "oracle"}
    assert results["scale"]["limit_bits_per_s"] == pytest.approx(4.52, abs=0.01)
    assert shell("data", "verify", "r/data").code == 0
    assert shell("data", "export", "r/data", "--out", "e.npz", "--no-pixels").code == 0
    with np.load(tmp_path / "e.npz") as exported:
        assert exported["state"].shape[1] == 6 and exported["action"].shape[1] == 2
    shown = shell(
        "view",
        *run,
        "--checkpoint",
        "r/train-hierarchy",
        "--methods",
        "hjepa",
        "--devices",
        "1",
        "--json",
    )
    assert shown.code == 0, shown.err
    assert shown.document["methods"]["hjepa"]["belief_error_z_m"] >= 0


def test_the_page_about_your_own_plant_is_complete(tmp_path):
    """Its two blocks are all that a system takes: put in place, every stage runs on it."""
    page = (ROOT / "docs/tutorials/own_plant.md").read_text()
    module, preset = (
        next(
            block for block in re.findall(rf"```{kind}\n(.*?)```", page, re.DOTALL) if word in block
        )
        for kind, word in (("python", "register("), ("toml", "plant ="))
    )
    (tmp_path / "pendulum.py").write_text(module)
    settings = tomllib.loads(preset)
    for section, values in tomllib.loads(TINY).items():  # smaller: the page's are for learning
        settings[section] = settings.get(section, {}) | values
    (tmp_path / "pendulum.toml").write_text(to_toml(settings))
    command = "reproduce --plugin pendulum.py --config pendulum.toml --methods hjepa,oracle"
    command += " --out run --quiet"
    done = subprocess.run(
        [sys.executable, "-m", "hjepa_cli", *command.split()],
        cwd=tmp_path,
        env={**ENVIRONMENT, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run/report.html").exists()
