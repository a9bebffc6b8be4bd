"""Files that lie end in a result or in an error for people, soon and in little memory.

The mutations are those of ``benchmarks/fuzz.py``, which tries many more; here hypothesis chooses
them, a thousand in all, and shrinks what fails.
"""

import random
import tempfile
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from test_benchmarks import load

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.networks.model import Model, build_modules, tensors_of
from hjepa_cli.errors import DataError, HjepaError, UsageError

fuzz = load("fuzz")
CASES = {
    "Checkpoint": 280,
    "Dataset": 230,
    "Curves": 180,
    "Shown": 120,
    "Records": 110,
    "Progress": 80,
    "Toml": 105,
}
MODELS = 15


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("name", [*CASES, "Networks"])
def test_mutated_files_are_refused_or_read(name: str, tmp_path: Path) -> None:
    target = getattr(fuzz, name)(tmp_path)
    outcomes = set()

    @settings(
        max_examples=CASES.get(name, MODELS),
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )
    @given(st.randoms(use_true_random=True), st.integers(0, 9))
    def attempt(chance: random.Random, turn: int) -> None:
        outcomes.add(fuzz.check(target, chance, measure=turn == 0))

    attempt()
    assert "DataError" in outcomes, "no mutation was noticed: the cases prove nothing"


def test_the_fuzzer_notices_a_traceback_and_a_bomb(tmp_path: Path) -> None:
    class Careless(fuzz.Target):  # type: ignore[misc, name-defined]
        harm: Any = None

        def damage(self, chance: random.Random) -> int:
            return 10

        def read(self) -> None:
            self.harm()

    target = Careless(tmp_path)
    target.harm = lambda: {}["x"]
    with pytest.raises(KeyError):
        fuzz.check(target, random.Random(0))
    target.harm = lambda: bytearray(2 * 10 + fuzz.OVERHEAD_BYTES + 1_000_000)
    with pytest.raises(AssertionError, match="bytes for a file of 10"):
        fuzz.check(target, random.Random(0), measure=True)


@pytest.mark.parametrize(
    "change",
    [
        {"embedding": 10**9},
        {"hidden": 10**12},
        {"actor_hidden": 10**15},
        {"embedding": -1},
        {"embedding": 8.0},
        {"kind": "else"},
        {"h": 9999, "m": 9999},
        {"h": "4"},
        {"m": 3},
        {"centre": 2},
    ],
)
def test_an_architecture_is_not_built_before_its_tensors_are_seen(
    tmp_path: Path, change: dict[str, Any]
) -> None:
    """The largest of these would take more memory than there is."""
    arrays = tensors_of(build_modules(fuzz.ARCHITECTURE))
    metadata = fuzz.METADATA | {"architecture": fuzz.ARCHITECTURE | change}
    chance = random.Random(0)
    chance.choice = lambda options: options[0]  # type: ignore[method-assign]
    (tmp_path / "a").write_bytes(fuzz.seal(arrays, metadata, chance))
    tracemalloc.start()
    with pytest.raises(DataError):
        Model.load(tmp_path / "a", "cpu")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2 * (tmp_path / "a").stat().st_size + fuzz.OVERHEAD_BYTES
    (tmp_path / "a").write_bytes(fuzz.seal(arrays, fuzz.METADATA, chance))
    Model.load(tmp_path / "a", "cpu")


@given(st.text())
@example("[" * 100_000)
@example("a = " + "[" * 100_000)
@example("seed = " + "9" * 5000)
@example("[encoder]\nlearning_rate = " + "9" * 400)
@example("#" * 2**20 + "#")
def test_any_text_is_settings_or_an_error_for_people(text: str) -> None:
    with tempfile.NamedTemporaryFile("w", encoding="utf-8", newline="") as file:
        file.write(text)
        file.flush()
        try:
            load_settings(config=file.name)
        except (DataError, UsageError) as error:
            assert isinstance(error, HjepaError) and error.message
