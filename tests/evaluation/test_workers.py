"""Units are handed out one by one, those of the first job before all others."""

import time
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from typing import Any

import pytest

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.evaluation import workers
from hjepa_cli.core.evaluation.workers import Workers

SETTINGS = load_settings()


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Units in the order in which they were computed."""
    units: list[str] = []

    def compute(make: Any, settings: Any, model: Any, unit: Any) -> tuple[str, int]:
        units.append(unit)
        time.sleep(0.005)  # long beside what a thread takes to ask for the next one
        if unit == "no":
            raise ValueError(unit)
        return unit.upper(), 1

    monkeypatch.setattr(workers, "compute", compute)
    return units


def ask(of: Workers, *units: str) -> list[str]:
    return of.results([of.submit(object, SETTINGS, None, unit) for unit in units])  # type: ignore[arg-type]


def test_what_the_first_job_asks_for_goes_before_all_others(computed: list[str]) -> None:
    def drive(job: str) -> list[str]:
        if job == "first":
            return [answer for step in "abc" for answer in ask(several, job + step)]
        return ask(several, *(f"{job}{number}" for number in range(30)))

    with ThreadPoolExecutor(1) as executor:
        several = Workers(executor, 1)
        found = dict(several.each(drive, ["first", "second", "third"]))
    assert found["first"] == ["FIRSTA", "FIRSTB", "FIRSTC"]
    assert found["third"] == [f"THIRD{number}" for number in range(30)]
    # Two of the others' between its steps, the one that runs and the one handed out, or a few.
    assert computed.index("firstc") <= computed.index("firsta") + 12
    assert len(computed) == 63


def test_a_unit_that_fails_is_raised_where_it_is_waited_for(computed: list[str]) -> None:
    with ThreadPoolExecutor(1) as executor:
        one = Workers(executor, 1)
        with pytest.raises(ValueError, match="no"):
            ask(one, "a", "no", "b")
        assert ask(one, "c") == ["C"] and computed == ["a", "no", "b", "c"]


def test_units_that_a_lost_cluster_cancels_are_not_waited_for() -> None:
    class Lost(Executor):
        def submit(self, *_: Any, **__: Any) -> "Future[Any]":
            future = Future[Any]()
            future.cancel()
            return future

    with pytest.raises(CancelledError):
        ask(Workers(Lost(), 2), "a", "b", "c", "d")


def test_a_pool_that_takes_nothing_more_fails_all_that_wait(computed: list[str]) -> None:
    executor = ThreadPoolExecutor(1)
    executor.shutdown()
    with pytest.raises(RuntimeError, match="shutdown"):
        ask(Workers(executor, 1), "a", "b", "c", "d")
    assert not computed
