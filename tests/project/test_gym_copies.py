"""Environments can be made again from their specification, copied, pickled and written down."""

import copy
import pickle

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.envs.registration import EnvSpec  # noqa: E402 - needs gymnasium
from gymnasium.wrappers import FrameStackObservation  # noqa: E402

import hjepa_cli  # noqa: E402
from hjepa_cli.errors import UsageError  # noqa: E402
from hjepa_cli.gym import LossyChannel  # noqa: E402

IDS = ("hjepa/CartPole-v0", "hjepa/CartPolePixels-v0")
COPIES = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
}


def made(name, **options):
    return LossyChannel(gymnasium.make(name, **options), 0.5)


def play(env, steps=20):
    """Observations and rewards of a few steps."""
    shares = np.random.default_rng(1).uniform(-1, 1, (steps, 1)).astype(np.float32)
    return [env.step(share)[:2] for share in shares]


def close(ours, theirs):
    for (seen, reward), (other, given) in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(seen, other, atol=1e-6)
        assert reward == pytest.approx(given, abs=1e-6)


@pytest.mark.parametrize("name", IDS)
def test_an_environment_is_made_again_from_its_spec(name):
    env = made(name, plant="gym", reward="score", action_repeat=2)
    for spec in (env.spec, EnvSpec.from_json(env.spec.to_json()), copy.deepcopy(env.spec)):
        again = gymnasium.make(spec)
        assert isinstance(again, LossyChannel) and again.delivery_probability == 0.5
        env.reset(seed=3), again.reset(seed=3)
        close(play(env), play(again))


@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("name", IDS)
def test_a_copy_goes_on_where_the_original_is(name, how):
    env = made(name)
    env.reset(seed=3)
    play(env, 7)
    again = COPIES[how](env)
    first = play(again)
    untouched = COPIES[how](env)
    close(first, play(env))
    close(first, play(untouched))  # the copy before has moved nothing but itself
    assert again.unwrapped._k == env.unwrapped._k == 27


def test_other_wrappers_around_it_are_made_again_too():
    env = FrameStackObservation(made(IDS[1]), 2)
    assert gymnasium.make(env.spec).observation_space == env.observation_space


@pytest.mark.parametrize("how", COPIES)
def test_a_public_cart_pole_can_be_copied(how):
    pole = hjepa_cli.CartPole("desktop", seed=3)
    for _ in range(5):
        pole.step(2.0)
    again = COPIES[how](pole)
    np.testing.assert_allclose(again.state, pole.state, atol=1e-15)
    np.testing.assert_allclose(again.step(1.0), pole.step(1.0), atol=1e-9)
    assert (hjepa_cli.Camera("desktop").render([pole.state]) ==
            COPIES[how](hjepa_cli.Camera("desktop")).render([pole.state])).all()  # fmt: skip


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan"), "x", None])
def test_a_channel_of_no_probability_is_refused(share):
    with pytest.raises(UsageError, match="expected 0 to 1"):
        LossyChannel(gymnasium.make(IDS[0]), share)


@pytest.mark.parametrize("action", [np.zeros(2), np.zeros(0)])
def test_an_action_is_one_number(action):
    env = gymnasium.make(IDS[0]).unwrapped
    env.reset(seed=0)
    with pytest.raises(UsageError, match="expected one number"):
        env.step(action)
