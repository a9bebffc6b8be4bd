"""Schedulers and the growth of errors behind them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hjepa_cli.core.control.error_growth import ErrorGrowthTable, conformal_growth
from hjepa_cli.core.radio.schedulers.scheduler import SlotView, pick
from hjepa_cli.errors import UsageError
from hjepa_cli.plugins import SCHEDULERS

# --- Error growth and Whittle's index ---------------------------------------------------------


def geometric(a, length=60):
    ages = np.arange(1, length + 1)
    return ErrorGrowthTable((a ** (2 * ages) - 1) / (a**2 - 1))


def test_index_by_its_definition():
    growth = geometric(1.05)
    f = growth.table
    for age in (1, 2, 7, 40):
        assert growth.index(age) == pytest.approx(age * f[age] - f[:age].sum())
    indices = growth.index(np.arange(1, 200))  # beyond the table too
    assert np.all(np.diff(indices) >= 0)
    assert growth.at([1, 60, 61, 500]) == pytest.approx([f[0], f[59], f[59], f[59]])


@pytest.mark.parametrize("age", [1, 3, 12])
def test_at_the_index_as_price_sending_now_or_a_slot_later_cost_the_same(age):
    f, price = geometric(1.1).table, float(geometric(1.1).index(age))

    def mean_cost(turn):  # a cycle of ages 1 … turn, one transmission
        return (f[:turn].sum() + price) / turn

    assert mean_cost(age) == pytest.approx(mean_cost(age + 1))
    assert mean_cost(age) < mean_cost(age + 2)


@pytest.mark.parametrize("scale", [[1.0, 2.0, 3.0], [2.0, 1.0, 3.0]], ids=["rising", "not"])
def test_conformal_quantile_covers_new_devices(scale):
    random = np.random.default_rng(0)
    ages, inside = (1, 4, 9), []
    for _ in range(400):
        growth = conformal_growth(ages, np.abs(random.normal(size=(19, 3))) * scale, 0.9)
        fresh = np.abs(random.normal(size=3)) * scale
        inside.append(fresh**2 <= growth.at(ages))
    # Rank 18 of 19 covers 0.9 exactly; the monotone table never less. 4 standard errors of 400.
    covered = np.mean(inside, axis=0)
    assert np.all(covered >= 0.9 - 4 * 0.015)
    assert covered[0] == pytest.approx(0.9, abs=4 * 0.015)


def test_growth_is_monotone_and_interpolated():
    growth = conformal_growth((2, 4, 6), np.tile([1.0, 0.5, 3.0], (20, 1)))
    assert np.all(np.diff(growth.table) >= 0)
    assert growth.at([1, 2, 4, 6]) == pytest.approx([0.25, 1.0, 1.0, 9.0])
    with pytest.raises(UsageError, match="9 or more"):
        conformal_growth((1,), np.ones((8, 1)))


# --- Scores -------------------------------------------------------------------------------------


def view(**changes):
    count = 5
    known = {
        "age": np.array([3, 9, 4, 9, 1]),
        "waited": np.array([5, 1, 2, 4, 3]),
        "gain": np.array([0.5, 2.0, 0.01, 1.0, 3.0]),
        "power": np.array([0.2, 0.05, 10.0, 0.1, 0.03]),
        "queue": np.zeros(count),
        "reported": np.array([0.0, 0.1, 0.9, 0.3, 0.0]),
        "growth": geometric(1.1),
        "uncertainty": np.ones(count),
    }
    return SlotView(**{**known, **changes})


@pytest.mark.parametrize(
    ("name", "order"),
    [
        ("round-robin", [0, 3, 4, 2, 1]),  # blind: also device 2, which is blocked
        ("opportunistic", [4, 1, 3, 0]),
        ("max-aoi", [1, 3, 0, 4]),
        ("whittle", [1, 3, 0, 4]),
        ("innovation", [3, 1, 0, 4]),
    ],
)
def test_who_wins(name, order):
    scores = SCHEDULERS[name].score(view())
    for blocks in range(1, 6):
        assert np.flatnonzero(pick(scores, blocks)).tolist() == sorted(order[:blocks])


def test_drift_plus_penalty_is_algorithm_2():
    age, queue, power = np.array([40, 40, 9, 60]), np.array([0.0, 3.0, 0.0, 7.0]), [0.5, 1, 1, 1.1]
    known = {key: np.ones(4, int) for key in ("waited", "uncertainty")}
    scores = SCHEDULERS["drift-plus-penalty"].score(
        SlotView(
            age=age,
            queue=queue,
            power=np.array(power),
            gain=np.ones(4),
            reported=np.zeros(4),
            growth=geometric(1.1),
            **known,
        )
    )
    cost = 1 - (age + 1.0) ** 2 - 2 * queue * age + 1000 * np.array(power)
    assert scores[:3] == pytest.approx(-cost[:3])
    assert scores[3] == 0.0  # beyond the power limit
    assert scores[2] < 0 and not pick(scores, 4)[2]  # not worth its power


@given(
    st.lists(st.integers(1, 300), min_size=2, max_size=30),
    st.floats(1.0, 1.2, exclude_min=True),
    st.integers(1, 8),
    st.integers(0, 99),
)
def test_age_value_and_whittle_agree_for_equal_loops(ages, a, blocks, seed):
    power = 0.1 / np.random.default_rng(seed).standard_exponential(len(ages))
    none = np.zeros(len(ages))
    known = view(
        age=np.array(ages),
        power=power,
        gain=none,
        queue=none,
        reported=none,
        waited=np.ones(len(ages), int),
        uncertainty=np.ones(len(ages)),
        growth=geometric(a, 400),
    )
    by_age = pick(SCHEDULERS["max-aoi"].score(known), blocks)
    assert np.array_equal(by_age, pick(SCHEDULERS["whittle"].score(known), blocks))
    value = np.where(known.able, known.growth.at(known.age), 0.0)  # value of information, myopic
    assert np.array_equal(by_age, pick(value, blocks))


def test_names():
    assert list(SCHEDULERS) == [
        *("round-robin", "opportunistic", "max-aoi", "drift-plus-penalty", "whittle"),
        "innovation",
    ]
    assert all(SCHEDULERS[name].name == name for name in SCHEDULERS)
