"""Which row of actions moves which picture is said where pictures tell, and only there."""

import io

import numpy as np
import pytest
import recordings

from hjepa_cli.core.datasets.importing import alignment
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages.import_data import tell_alignment

EPISODES, STEPS = 16, 30


def judged(place_by, *, late=0):
    """Judge a square that a law and noise push; ``place_by`` says what moves it in a step.

    Its row j leads from picture j to j + 1, and is logged ``late`` rows later.
    """
    random = np.random.default_rng(1)
    frames = np.zeros((EPISODES, STEPS, recordings.H, recordings.W, 3), np.uint8)
    actions = np.zeros((EPISODES, STEPS, 2))
    middle = np.array([recordings.H, recordings.W]) / 2
    for n in range(EPISODES):
        place, speed = random.uniform(-1, 1, 2) * [5, 12], random.uniform(-1, 1, 2)
        for k in range(STEPS):
            frames[n, k] = recordings.square(middle + place)
            actions[n, k] = -0.06 * place - 0.5 * speed + random.normal(0, 0.4, 2)
            before, speed = speed, 0.95 * speed + 0.5 * actions[n, k]
            place = (place + place_by(before, speed)).clip(-8, 8)
    return alignment.judge(list(frames), list(np.roll(actions, late, axis=1)))


def told(verdict, offset=0):
    """Return what the import says of a verdict."""
    said = io.StringIO()
    tell_alignment(verdict, offset, Screen(stderr=said))
    return " ".join(said.getvalue().split())


PLANTS = {  # what a step adds to the place, and the row that four pictures show as well
    "speed first": (lambda before, after: after, 1),
    "place first": (lambda before, after: before, -1),
}


@pytest.mark.parametrize("plant", PLANTS)
def test_a_row_that_the_pictures_show_as_well_is_not_recommended(plant):
    place_by, other = PLANTS[plant]
    verdict = judged(place_by)
    assert {0, other} <= set(verdict.alike) and not verdict.clear, verdict
    assert f"better than 0 (R² {verdict.r2[0]:.2f}); about as well fits {other} (R²" in told(
        verdict
    )


def test_actions_that_are_logged_late_are_found_where_force_is_held_over_a_step():
    verdict = judged(lambda before, after: (before + after) / 2, late=2)
    assert verdict.clear and verdict.best == 2 and verdict.alike == [2]
    assert told(verdict, 1).endswith("--action-offset 3 says so")


@pytest.mark.parametrize(
    "r2, best, clear",
    [
        ([0.16, 0.19, 0.38, 0.96, 0.98, 0.36, 0.05], 1, False),  # half the error, and both fit
        ([0.05, 0.09, 0.09, 0.30, 0.53, 0.28, 0.10], 1, True),
        ([-5.4, -4.9, -3.7, -2.3, -1.5, -1.6, -2.6], 1, False),  # worse than the mean of all
        ([0.05, 0.09, 0.09, 0.28, 0.30, 0.40, 0.53], 3, False),  # who knows what comes beyond
    ],
)
def test_what_is_left_decides(r2, best, clear):
    left = 1 - np.array(r2)
    verdict = alignment.decided(left, left)
    assert (verdict.best, verdict.clear) == (best, clear)
    assert verdict.alike == [] or best in verdict.alike
    assert ("warning" in told(verdict)) == clear
