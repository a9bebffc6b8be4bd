"""Gymnasium environments: Gymnasium's own checks, the plant's equations, the channel's losses."""

import re
import warnings

import numpy as np
import pytest
from command_line import ROOT

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env  # noqa: E402 - needs gymnasium

import hjepa_cli.gym  # noqa: E402 - needs gymnasium
from hjepa_cli.config.settings import load_settings  # noqa: E402
from hjepa_cli.core.control.loop import ScoredPlants  # noqa: E402
from hjepa_cli.core.plants.named import Camera, CartPole, plant, teacher  # noqa: E402
from hjepa_cli.errors import NumericalError, UsageError  # noqa: E402

IDS = ("hjepa/CartPole-v0", "hjepa/CartPolePixels-v0")


@pytest.mark.parametrize("name", IDS)
@pytest.mark.parametrize("kind", ["desktop", "gym"])
def test_gymnasiums_own_checks_pass_without_a_warning(name, kind):
    check_env(gymnasium.make(name, plant=kind, render_mode="rgb_array").unwrapped)


def test_a_step_is_the_plants_and_the_reward_is_the_cost():
    env = gymnasium.make(IDS[0], noise=False).unwrapped
    kind = plant("desktop")
    env.reset(seed=3)
    pole = CartPole(kind)
    pole.state = state = env.reset(seed=3)[1]["state"]
    for action in (0.5, -1.0, 3.0):  # the last is clipped
        observation, reward, terminated, truncated, info = env.step(np.array([action], np.float32))
        force_n = 20 * min(action, 1.0)
        cost = sum(q * x * x for q, x in zip((20, 0.5, 20, 0.05), state, strict=True))
        cost = min(cost + 0.05 * force_n**2, 50)
        assert reward == pytest.approx(1 - cost / 50, abs=1e-9)
        state = pole.step(force_n)
        np.testing.assert_allclose(info["state"], state, atol=1e-9)
        np.testing.assert_allclose(observation, state, atol=1e-6)
        assert not terminated and not truncated


@pytest.mark.parametrize("kind", ["desktop", "gym"])
def test_an_episode_starts_where_the_closed_loop_does(kind):
    env = gymnasium.make(IDS[0], plant=kind).unwrapped
    observation, info = env.reset(seed=3)
    protocol = load_settings("gym" if kind == "gym" else None).protocol
    random, _ = gymnasium.utils.seeding.np_random(3)
    initial = random.uniform(-1, 1, (1, 4)) * protocol.half_widths
    world = ScoredPlants(plant(kind), initial, np.ones((1, 2)), iter(()))
    np.testing.assert_array_equal(info["state"], world.states[0])
    assert (info["state"] != initial[0]).any()
    np.testing.assert_allclose(observation, world.states[0], rtol=1e-6)


@pytest.mark.parametrize("share", [np.nan, np.inf, -np.inf])
def test_an_action_that_is_not_finite_is_an_error_and_moves_nothing(share):
    env = gymnasium.make(IDS[0]).unwrapped
    _, before = env.reset(seed=0)
    with pytest.raises(NumericalError, match="the action is not finite at step 0"):
        env.step(np.array([share], np.float32))
    np.testing.assert_array_equal(env._pole.state, before["state"])


def test_a_repeated_action_is_held_and_its_reward_averaged():
    once, held = (
        gymnasium.make(IDS[0], noise=False, reward="score", action_repeat=n).unwrapped
        for n in (1, 4)
    )
    for env in (once, held):
        env.reset(seed=1)
    action = np.array([0.3], np.float32)
    rewards = [once.step(action)[1] for _ in range(4)]
    observation, reward, *_, info = held.step(action)
    assert reward == np.mean(rewards) == info["score"]
    assert once.render_mode is None and held.metadata["render_fps"] == 250
    np.testing.assert_array_equal(observation, once._observe())


def test_the_noise_is_the_protocols():
    """With and without noise the next states differ by draws of the protocol's deviations."""
    protocol = load_settings(flags={"protocol": "paper"}).protocol
    action = np.zeros(1, np.float32)
    differences = []
    noisy, quiet = (gymnasium.make(IDS[0], noise=flag).unwrapped for flag in (True, False))
    for seed in range(300):
        noisy.reset(seed=seed)
        quiet.reset(seed=seed)
        differences.append(noisy.step(action)[4]["state"] - quiet.step(action)[4]["state"])
    deviation = np.std(differences, axis=0)
    assert deviation[0] == deviation[2] == 0
    # relative standard error of a deviation from 300 draws: 1 / sqrt(600) = 4 %
    expected = [protocol.noise_x_dot_m_s, protocol.noise_theta_dot_rad_s]
    np.testing.assert_allclose(deviation[[1, 3]], expected, rtol=0.16)


def test_an_episode_ends_by_time_under_the_teacher_and_by_falling_without():
    env = gymnasium.make(IDS[0], action_repeat=10).unwrapped
    act = teacher("desktop")
    _, info = env.reset(seed=0)
    scores = []
    for step in range(1, 101):
        force = act(info["state"]) / 20
        _, _, terminated, truncated, info = env.step(np.array([force], np.float32))
        assert not terminated and truncated == (step == 100)
        scores.append(info["score"])
    assert np.mean(scores) > 0.7
    env.reset(seed=0)
    for _ in range(60):
        _, _, terminated, truncated, info = env.step(np.ones(1, np.float32))
        if terminated:
            break
    assert terminated and not truncated
    x_m, _, theta_rad, _ = info["state"]
    assert abs(x_m) > 0.3 or abs(theta_rad) > np.pi / 2


@pytest.mark.parametrize("repeat", [1, 7])
def test_after_the_end_the_plant_goes_on_by_single_steps(repeat):
    """As under Gymnasium's own time limit: still truncated, with the rewards of what happens."""
    env = gymnasium.make(IDS[0], plant="gym", noise=False, action_repeat=repeat).unwrapped
    _, info = env.reset(seed=0)
    action, pole = np.full(1, 0.125, np.float32), CartPole("gym")  # 2.5 N
    truncated, steps = False, 0
    while not truncated:
        _, _, _, truncated, info = env.step(action)
        steps += 1
    assert steps == -(-300 // repeat)
    for _ in range(3):
        pole.state = info["state"]
        _, reward, _, truncated, info = env.step(action)
        assert truncated and reward <= 1 - 0.05 * 2.5**2 / 50  # R u², at least
        np.testing.assert_allclose(info["state"], pole.step(2.5), atol=1e-9)


def test_pixels_are_the_cameras_and_stack_to_what_encoders_take():
    env = gymnasium.wrappers.FrameStackObservation(gymnasium.make(IDS[1]), 2)
    env.reset(seed=0)
    states = [env.unwrapped._pole.state]
    for _ in range(3):
        pair, *_, info = env.step(np.array([0.2], np.float32))
        states.append(info["state"])
    assert pair.shape == (2, 64, 128, 3) and pair.dtype == np.uint8
    np.testing.assert_array_equal(pair, Camera("desktop").render(np.array(states[-2:])))


def test_equal_seeds_give_equal_episodes():
    def episode(seed):
        env = hjepa_cli.gym.LossyChannel(gymnasium.make(IDS[0]), 0.5)
        seen = [env.reset(seed=seed)[0]]
        seen += [env.step(np.array([0.1], np.float32))[0] for _ in range(20)]
        return np.array(seen)

    assert (episode(5) == episode(5)).all() and (episode(5) != episode(6)).any()


def test_wrong_options_are_refused():
    for options in (
        {"reward": "win"},
        {"plant": "cart"},
        {"action_repeat": 0},
        {"action_repeat": 2.5},
    ):
        with pytest.raises(UsageError):
            hjepa_cli.gym.CartPoleEnv(**options)
    with pytest.raises(UsageError):
        hjepa_cli.gym.LossyChannel(gymnasium.make(IDS[0]), 1.5)


# --- the channel


def test_losses_show_the_last_delivered_observation_and_its_age():
    env = hjepa_cli.gym.LossyChannel(gymnasium.make(IDS[0]), 0.3)
    first, info = env.reset(seed=0)
    assert info["delivered"] and info["age_steps"] == 0
    held, age, arrived = first, 0, []
    for _ in range(600):
        seen, _, terminated, _, info = env.step(np.zeros(1, np.float32))
        if info["delivered"]:
            held, age = info["state"].astype(np.float32), 0
        else:
            age += 1
        assert info["age_steps"] == age
        np.testing.assert_array_equal(seen, held)
        arrived.append(info["delivered"])
        if terminated:
            held, age = env.reset()[0], 0
    # standard error of a share of 600: sqrt(0.3 * 0.7 / 600) = 0.019; four of them
    assert np.mean(arrived) == pytest.approx(0.3, abs=0.076)


def test_a_perfect_channel_changes_nothing_and_a_dead_one_shows_the_start_forever():
    plain = gymnasium.make(IDS[0])
    perfect, dead = (hjepa_cli.gym.LossyChannel(gymnasium.make(IDS[0]), p) for p in (1.0, 0.0))
    start = [env.reset(seed=2)[0] for env in (plain, perfect, dead)]
    for _ in range(5):
        seen = [env.step(np.full(1, 0.4, np.float32))[0] for env in (plain, perfect, dead)]
        np.testing.assert_array_equal(seen[0], seen[1])
        np.testing.assert_array_equal(seen[2], start[2])


# --- Stable-Baselines3


def test_the_documented_run_of_stable_baselines3(monkeypatch, tmp_path, capsys):
    """The block of docs/how-to/agents.md as it stands, with fewer steps."""
    pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs/how-to/agents.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    (code,) = [block for block in blocks if "stable_baselines3" in block]
    short = re.sub(r"total_timesteps=[\d_]+", "total_timesteps=128", code)
    short = re.sub(r"n_steps=\d+, batch_size=\d+", "n_steps=16, batch_size=16", short)
    short = re.sub(r"n_eval_episodes=\d+", "n_eval_episodes=1", short)
    assert short != code
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # other people's deprecations
        exec(compile(short, "docs/how-to/agents.md", "exec"), {"__name__": "agents"})
    assert "return" in capsys.readouterr().out
