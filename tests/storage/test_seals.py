"""Derived files are what was written: no change goes unnoticed, none without a seal is a cache."""

import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_line import Shell, assert_one_line_error, open_shell

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.evaluation import curves
from hjepa_cli.core.evaluation.curves import Digest
from hjepa_cli.errors import DataError, HjepaError, Unsealed
from hjepa_cli.storage import seals
from hjepa_cli.storage.runs import Run, read_config, read_result
from hjepa_cli.storage.zoo import verify_model, zoo_directory

SETTINGS = load_settings("smoke").as_dict()
ZOO = zoo_directory() / "desktop-reflex"


@pytest.fixture
def shell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Shell:
    return open_shell(tmp_path, monkeypatch, capsys)


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return Path(shutil.copytree(ZOO, tmp_path / "model"))


def finished_run(directory: Path) -> Path:
    with Run.create("eval", directory, SETTINGS) as run:
        run.metric({"step": 1, "loss": 0.5})
        (directory / "devices.csv").write_text("method,devices\nhold,12\n")
        run.finish({"score": 0.5, "rows": [{"devices": 12}]})
    return directory


def rewrite(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def unseal(path: Path, schema: int = 1) -> None:
    """Make a file one of the version before there were seals."""
    rewrite(path, lambda document: (document.pop("sha256"), document.update(schema=schema)))


def forge(document: dict[str, Any]) -> None:
    document["methods"]["chunk"]["tolerance_gap_steps"] += 0.5


def test_one_digit_of_curves_is_noticed_by_verify_and_scale(shell: Shell, model: Path) -> None:
    assert shell("models", "verify", "model").code == 0
    rewrite(model / "curves.json", forge)
    outcome = shell("models", "verify", "model")
    assert_one_line_error(outcome, 65, "curves.json", "changed", "--remeasure")
    scale = ("scale", "--checkpoint", "model", "--methods", "chunk", "--out", "run")
    assert_one_line_error(shell(*scale), 65, "curves.json", "changed", "--remeasure")


def test_curves_of_the_present_schema_without_a_seal_are_refused(shell: Shell, model: Path) -> None:
    rewrite(model / "curves.json", lambda document: document.pop("sha256"))
    assert_one_line_error(shell("models", "verify", "model"), 65, "it has no sha256")


def test_curves_without_a_seal_are_read_where_they_are_named_and_never_a_cache(
    shell: Shell, model: Path
) -> None:
    unseal(model / "curves.json")
    outcome = shell("models", "verify", "model")
    assert outcome.code == 0 and "warning: " in outcome.err and "no seal" in outcome.err
    document = json.loads((model / "curves.json").read_text())
    digest = Digest(**document["digest"])
    with pytest.warns(Unsealed, match="not used"):
        assert curves.find(digest, ["chunk"], [model / "curves.json"], root=Path("none")) == {}
    old = Path("runs/eval/0001")
    old.mkdir(parents=True)
    shutil.copy(model / "curves.json", old)
    assert curves.find(digest, ["chunk"], []) == {}


@pytest.mark.parametrize(
    "change",
    [
        {"tolerance_gap_ci95": [150.0, 100.0]},
        {"tolerance_gap_ci95": [1.0, 2.0]},
        {"tolerance_gap_steps": 1e12, "tolerance_gap_ci95": [0.0, 1e12]},
        {"tolerance_p": 1.5, "tolerance_p_ci95": [1.0, 2.0]},
        {"score": -1.0, "score_ci95": [-1.0, -1.0]},
        {"tolerance_gap_lost": 2.0},
        {"nmae": []},
    ],
)
def test_impossible_values_are_refused_under_the_right_seal(
    model: Path, change: dict[str, Any]
) -> None:
    path = model / "curves.json"
    document = json.loads(path.read_text())
    assert set(curves.read(path, Digest(**document["digest"]), named=True)) <= {
        "chunk", "chunk-forces", "hold-decay", "hold-decay-linear",
    }  # fmt: skip
    document["methods"]["chunk"] |= change
    path.write_text(json.dumps(seals.sealed(document)))
    with pytest.raises(DataError, match="method 'chunk'"):
        curves.read(path, Digest(**document["digest"]))


def test_results_and_tables_are_sealed(shell: Shell) -> None:
    run = finished_run(Path("run"))
    assert read_result(run) == {"score": 0.5, "rows": [{"devices": 12}]}
    for name, change in (
        ("result.json", lambda text: text.replace("0.5", "0.6")),
        ("result.json", lambda text: text.replace('"schema"', '"scheme"')),
        ("metrics.csv", lambda text: text.replace("0.5", "0.1")),
        ("devices.csv", lambda text: text.replace("12", "24")),
        ("devices.csv", None),
    ):
        path = run / name
        before = path.read_text()
        if change is None:
            path.unlink()
        else:
            path.write_text(change(before))
        with pytest.raises(DataError, match=name) as caught:
            read_result(run)
        assert caught.value.hint == "run it again: hjepa eval --config run/config.toml"
        path.write_text(before)
    rewrite(run / "result.json", lambda result: (result.pop("sha256"), result.pop("schema")))
    with pytest.raises(DataError, match="it has no sha256"):
        read_result(run)
    rewrite(run / "environment.json", lambda record: record.update(schema=2))
    with pytest.warns(Unsealed, match=r"result\.json has no seal"):
        assert read_result(run)["score"] == 0.5


def test_verify_checks_the_run_around_a_model(shell: Shell) -> None:
    shutil.copy(ZOO / "model.safetensors", finished_run(Path("run")))
    assert verify_model("run").name == "run"
    Path("run/metrics.csv").write_text("step,loss\n1,0.1\n")
    assert_one_line_error(shell("models", "verify", "run"), 65, "run/metrics.csv was changed")


def test_a_result_may_not_use_the_words_of_its_seal(tmp_path: Path) -> None:
    with Run.create("eval", tmp_path / "run", SETTINGS) as run:
        with pytest.raises(ValueError, match="reserved"):
            run.finish({"files": []})


def test_settings_that_were_changed_are_named(shell: Shell) -> None:
    with Run.create("eval", Path("run"), SETTINGS):
        pass
    config = Path("run/config.toml")
    config.write_text(config.read_text().replace("seed = 0\n", "seed = 8\n"))
    outcome = shell("resume", "run")
    assert_one_line_error(outcome, 65, "config.toml was changed", "seed = 0, not 8", "--out DIR")


def test_no_mutation_changes_what_is_read(tmp_path: Path, model: Path) -> None:
    """Some thousand bytes of the derived files, one at a time: the same values, or an error."""
    run, chance = finished_run(tmp_path / "run"), random.Random(0)
    document = json.loads((model / "curves.json").read_text())
    digest = Digest(**document["digest"])
    few = document | {"methods": {"chunk": document["methods"]["chunk"]}}
    (model / "curves.json").write_text(json.dumps(seals.sealed(few)))
    reads: dict[Path, Callable[[], Any]] = {
        model / "curves.json": lambda: curves.read(model / "curves.json", digest),
        run / "result.json": lambda: read_result(run),
        run / "metrics.csv": lambda: read_result(run),
        run / "devices.csv": lambda: read_result(run),
        run / "config.toml": lambda: read_config(run),
    }
    for path, read in reads.items():
        good, expected = path.read_bytes(), read()
        for _ in range(300):
            data = bytearray(good)
            data[chance.randrange(len(data))] = chance.choice(b'0123456789.-,"x \n')
            path.write_bytes(data)
            try:
                assert read() == expected, data
            except HjepaError:
                pass
        path.write_bytes(good)
