"""Records of others: whatever stands in them, a result is shown or refused, and nothing crashes."""

import json
import shutil
from pathlib import Path

import pytest
from command_line import Shell, assert_one_line_error, open_shell
from test_benchmarks import load

from hjepa_cli.core.datasets import dataset as datasets
from hjepa_cli.stages import report
from hjepa_cli.storage import runs, seals

fuzz = load("fuzz")


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """Two evaluations, a count of devices and a training, as the fuzzer makes them."""
    return fuzz.Shown(tmp_path_factory.mktemp("made")).path


@pytest.fixture
def shell(made, tmp_path, monkeypatch, capsys) -> Shell:
    shutil.copytree(made, tmp_path / "runs")
    monkeypatch.setattr(report, "draw", lambda *_: {})  # which takes most of the time
    return open_shell(tmp_path, monkeypatch, capsys)


def change(path: Path, edit) -> None:
    """Make a record lie under the right seals."""
    document = json.loads(path.read_text())
    edit(document)
    path.write_text(json.dumps(seals.sealed(document) if "sha256" in document else document))
    result = path.with_name(runs.RESULT)
    if path != result:
        sealed = json.loads(result.read_text())
        sealed["files"][path.name] = datasets.hashlib.sha256(path.read_bytes()).hexdigest()
        result.write_text(json.dumps(seals.sealed(sealed)))


def put(*keys, value):
    """An edit of a value deep inside."""

    def edit(document) -> None:
        for key in keys[:-1]:
            document = document[key]
        document[keys[-1]] = value

    return edit


def drop(*keys):
    def edit(document) -> None:
        for key in keys[:-1]:
            document = document[key]
        del document[keys[-1]]

    return edit


RESULTS = [
    ("eval-0", put("methods", value=[])),
    ("eval-0", put("methods", "hjepa", value=None)),
    ("eval-0", put("methods", "hjepa", "score_ci95", value=None)),
    ("eval-0", put("methods", "hjepa", "nmae_windows", value={})),
    ("eval-0", put("methods", "hjepa", "nmae_windows", "1-20", value="x")),
    ("eval-0", drop("methods", "hjepa", "gap_curve")),
    ("eval-0", put("plant", value=3)),
    ("eval-0", put("checkpoint", value=7)),
    ("scale", put("rows", value=[])),
    ("scale", put("rows", 0, "devices", value="many")),
    ("scale", put("rows", 0, "devices_ci95", value=[1])),
    ("scale", put("rows", 0, "method", value=None)),
    ("scale", put("rows", 0, "snr_db", value="ten")),
    ("scale", put("gains", 0, "ratio_ci95", value=3)),
    ("scale", put("bandwidth_hz", value="wide")),
    ("scale", put("law", value="none of ours")),
    ("scale", put("slot_s", value=0)),
    ("trained", put("gates", "effective_rank", value=9.5)),
    ("trained", put("seconds", value="long")),
]
ENVIRONMENTS = [
    ("eval-0", put("versions", value=3)),
    ("eval-0", put("versions", value=["torch"])),
    ("eval-0", put("command", value="hjepa")),
    ("eval-0", put("command", value=[1, {}])),
    ("eval-0", put("inputs", value=[])),
    ("eval-0", put("inputs", value={"dataset": {"path": 3, "sha256": "0"}})),
    ("eval-0", put("preset", value=3)),
    ("eval-0", put("stage", value=None)),
    ("eval-0", put("plugins", value=[3])),
    ("eval-0", put("cpus", value="all")),
    ("eval-0", put("settings", value=[])),
]


@pytest.mark.parametrize(("run", "edit"), RESULTS)
def test_a_result_that_is_none_of_its_stage_is_refused(shell, run, edit) -> None:
    change(Path("runs", run, runs.RESULT), edit)
    assert_one_line_error(shell("report", f"runs/{run}", "--quiet"), 65, f"runs/{run}/result.json")
    if run.startswith("eval"):
        failed = shell("compare", "runs/eval-0", "runs/eval-1", "--quiet")
        assert failed.code in (65, 66, 0) and "unexpected" not in failed.err, failed


def test_a_plant_that_nobody_knows_is_refused(shell, monkeypatch) -> None:
    monkeypatch.undo()  # figures are drawn, with its control step
    monkeypatch.chdir(shell.directory)
    change(Path("runs/eval-0", runs.RESULT), put("plant", value="gone"))
    assert_one_line_error(shell("report", "runs/eval-0", "--quiet"), 65, "unknown plant 'gone'")
    failed = shell("compare", "runs/eval-0", "runs/eval-1", "--quiet")
    assert_one_line_error(failed, 65, "unknown plant 'gone'")


@pytest.mark.parametrize(("run", "edit"), ENVIRONMENTS)
def test_surroundings_that_are_none_are_refused(shell, run, edit) -> None:
    change(Path("runs", run, runs.ENVIRONMENT), edit)
    for command in (["report", f"runs/{run}"], ["compare", f"runs/{run}", "runs/eval-1"],
                    ["resume", f"runs/{run}"]):  # fmt: skip
        assert_one_line_error(shell(*command, "--quiet"), 65, "environment.json")


@pytest.mark.parametrize("name", ["config.toml", "environment.json", "metrics.csv", "result.json"])
def test_a_digit_changed_in_any_record_of_a_finished_run_is_noticed(shell, name) -> None:
    path = Path("runs/trained", name)
    text = path.read_text()
    for digit in "1234567890":
        if (at := text.find(digit)) >= 0:
            path.write_text(text[:at] + str((int(digit) + 1) % 10) + text[at + 1 :])
            failed = shell("report", "runs/trained", "--quiet")
            assert failed.code == 65 and failed.err.startswith("error: "), (digit, failed)
            path.write_text(text)
    assert shell("report", "runs/trained", "--quiet").code == 0


def test_one_damaged_shard_does_not_hide_the_others(shell) -> None:
    """A person with a failing disk wants to know all that is lost."""
    assert shell("collect", "--preset", "smoke", "--out", "data").code == 0
    for name in ("shard-00000.safetensors", "shard-00002.safetensors"):
        with open(Path("data", name), "r+b") as file:
            file.seek(200)
            file.write(b"\xff")
    failed = shell("data", "verify", "data", "--quiet")
    assert_one_line_error(failed, 65, "2 files are damaged", "shard-00000", "shard-00002")
    Path("data/shard-00001.safetensors").unlink()
    failed = shell("data", "verify", "data", "nowhere", "--quiet")
    assert failed.code == 65 and failed.err.count("shard-0000") == 3 and "nowhere" in failed.err
    shutil.rmtree("data")
    assert shell("collect", "--preset", "smoke", "--out", "data").code == 0
    assert shell("data", "verify", "data").code == 0


def test_an_unreadable_shard_is_one_of_them(shell, monkeypatch) -> None:
    assert shell("collect", "--preset", "smoke", "--out", "data").code == 0
    read = Path.read_bytes

    def refuse(path: Path) -> bytes:
        if path.name == "shard-00000.safetensors":
            raise OSError(5, "Input/output error")
        return read(path)

    monkeypatch.setattr(Path, "read_bytes", refuse)
    with open("data/shard-00001.safetensors", "ab") as file:
        file.write(b"x")
    failed = shell("data", "verify", "data", "--quiet")
    assert_one_line_error(failed, 65, "2 files", "Input/output error", "shard-00001")
