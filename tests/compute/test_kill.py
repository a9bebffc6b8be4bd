"""Real processes, killed at random moments of each stage: old or new files, and the same end.

The moments are counted in calls to the disk, not in seconds: the same ones on any machine.

``benchmarks/kill.py`` does it more often.
"""

import random
import sys
from multiprocessing.context import BaseContext
from pathlib import Path

import pytest
from test_benchmarks import REPOSITORY

sys.path.insert(0, str(REPOSITORY / "benchmarks"))  # children import it by name
import kill

sys.path.pop(0)


@pytest.fixture(scope="module")
def context(tmp_path_factory: pytest.TempPathFactory) -> BaseContext:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(REPOSITORY / "benchmarks")
        return kill.context()


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("kill")


@pytest.mark.parametrize("stage", kill.STAGES)
def test_killed_and_continued_is_whole(
    stage: str,
    root: Path,
    context: BaseContext,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(REPOSITORY / "benchmarks")
    calls = kill.run_whole(context, stage, root)
    chance = random.Random(stage)
    moments = [chance.random() for _ in range(3)]
    out = root / f"{stage}-killed"
    killed, _ = kill.kill_stage(context, stage, root, out, calls, moments)
    assert killed == 3


def test_killed_while_it_writes_and_continued_is_whole(
    context: BaseContext, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Random moments seldom hit an open file: here the first one that does is looked for."""
    monkeypatch.syspath_prepend(REPOSITORY / "benchmarks")
    calls = kill.run_whole(context, "collect", tmp_path)
    for last in range(calls // 2, calls):  # shards come in the second half
        out = tmp_path / f"killed-before-call-{last}"
        kill.run_child(context, "collect", tmp_path, out, last)
        if kill.check_files(out):
            break
    assert kill.check_files(out) == 1
    assert kill.run_child(context, "collect", tmp_path, out, 0, True) == 0
    kill.compare(tmp_path / "collect", out)
    assert kill.check_files(out) == 0


def test_the_comparison_can_fail(root: Path, tmp_path: Path) -> None:
    whole, other = tmp_path / "whole", tmp_path / "other"
    for directory in (whole, other):
        directory.mkdir()
        (directory / "result.json").write_text("{}")
        (directory / "metrics.csv").write_text("a\n1\n")
    kill.compare(whole, other)
    (other / "metrics.csv").write_text("a\n1\n1\n")
    with pytest.raises(AssertionError):
        kill.compare(whole, other)
    (other / "metrics.csv").unlink()
    with pytest.raises(AssertionError):
        kill.compare(whole, other)
