"""Benchmarks start, and fail loudly; how fast things are is for a quiet machine to say."""

import importlib.util
import os
import re
import subprocess
import sys
import tomllib
from operator import attrgetter
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy import stats

from hjepa_cli.config.checks import check_settings
from hjepa_cli.config.schema import Settings, dotted
from hjepa_cli.config.settings import load_settings
from hjepa_cli.plugins import METHODS

REPOSITORY = Path(__file__).resolve().parents[2]
BENCHMARKS = REPOSITORY / "benchmarks"
SCRIPTS = sorted(path for path in BENCHMARKS.glob("*.py") if "def main(" in path.read_text())


def load(name: str) -> ModuleType:
    """A benchmark as a module; those that it imports lie beside it."""
    spec = importlib.util.spec_from_file_location(name, BENCHMARKS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def helps() -> dict[str, tuple[int, str, str]]:
    """Exit code and output of every ``--help``, all started at once."""
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    running = {
        script.name: subprocess.Popen(
            [sys.executable, str(script), "--help"],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for script in SCRIPTS
    }
    outputs = {name: process.communicate(timeout=120) for name, process in running.items()}
    return {name: (running[name].returncode, *output) for name, output in outputs.items()}


@pytest.mark.parametrize("name", [script.name for script in SCRIPTS])
def test_help_describes_the_benchmark(name: str, helps: dict[str, tuple[int, str, str]]) -> None:
    code, shown, errors = helps[name]
    missing = re.search(r"No module named '(?!hjepa_cli)(\w+)", errors)
    if missing:
        pytest.skip(f"needs {missing[1]}")
    assert code == 0, errors
    assert "usage:" in shown and name in shown and not errors


def test_there_are_benchmarks() -> None:
    assert {"closed_loop.py", "commands.py", "train_step.py"} <= {path.name for path in SCRIPTS}


def test_a_failing_command_ends_the_benchmark_with_its_code_and_words(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    commands = load("commands")
    monkeypatch.setattr(commands, "SUITES", {"broken": ("collect --plant nonsense", "eval")})
    monkeypatch.setattr(sys, "argv", ["commands.py", "broken"])
    with pytest.raises(SystemExit) as ended:
        commands.main()
    assert ended.value.code == 2
    shown = capfd.readouterr()
    assert "hjepa collect --plant nonsense" in shown.err and "desktop" in shown.err
    assert "in all" not in shown.out


def test_the_memory_of_a_device_is_not_that_of_its_server(tmp_path: Path) -> None:
    """Of a program that is small as a device and takes 200 MB as a server."""
    package = tmp_path / "hjepa_cli"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "__main__.py").write_text(
        "import json, sys, time\n"
        "if sys.argv[1] == 'serve':\n"
        "    held = bytearray(b'x') * 200_000_000\n"
        "    print(json.dumps({'serving': 'here'}), flush=True)\n"
        "    time.sleep(60)\n"
    )
    ran = subprocess.run(
        [sys.executable, BENCHMARKS / "wire.py", "exported", "start", "--rounds", "1"],
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert not ran.returncode, ran.stderr
    assert int(re.findall(r"peak (\d+) MB", ran.stdout)[0]) < 100


def test_the_training_step_is_measured_against_its_promises() -> None:
    shortfalls = load("train_step").shortfalls
    assert shortfalls({"hjepa": 1.0, "bare": 0.9, "shared": 0.1, "plain": 5.0}) == []
    (slow,) = shortfalls({"bare": 0.95, "plain": 4.99})
    assert "plain" in slow and "4.99" in slow
    (slow,) = shortfalls({"bare": 0.89, "plain": 12.0})
    assert "bare" in slow


def test_the_closed_loop_is_timed_in_parts_and_as_a_whole(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    closed_loop = load("closed_loop")
    timed = closed_loop.seconds
    monkeypatch.setattr(closed_loop, "seconds", lambda work: timed(work, at_least_s=0.0))
    arguments = ["closed_loop.py", "--checkpoint", "desktop-h4m2l1", "--devices=2", "--steps=2"]
    monkeypatch.setattr(sys, "argv", arguments)
    closed_loop.main()
    shown = capsys.readouterr().out
    for name in ("hjepa", "ts-jepa-1", "hold", "oracle"):
        assert re.search(rf"^{name} .*\d x at D = 80$", shown, re.MULTILINE), name
    assert re.search(r"^hjepa .* 1\.25 million MACs", shown, re.MULTILINE)


STUDIES = sorted((REPOSITORY / "benchmarks" / "studies").glob("*.toml"))


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_every_row_of_a_study_is_a_recipe_with_a_name_of_its_own(
    path: Path, tmp_path: Path
) -> None:
    study, as_toml = tomllib.loads(path.read_text()), load("study").as_toml
    assert set(study) - {"common", "axis"} == {"methods", "row"} and set(study["methods"]) <= set(
        METHODS
    )
    rows = load("study").rows_of(study)
    names = [row["name"] for row in rows]
    assert len(set(names)) == len(names)
    recipes = []
    for row in rows:
        sections = {key: value for key, value in row.items() if isinstance(value, dict)}
        config = tmp_path / "config.toml"
        config.write_text(as_toml(sections))
        assert tomllib.loads(config.read_text()) == sections
        settings = load_settings(row.get("preset"), config)
        check_settings(settings)
        for section, values in sections.items():
            for key, value in values.items():
                read = getattr(getattr(settings, section), key)
                assert (list(read) if isinstance(read, tuple) else read) == value
        recipes.append((settings, *row.get("strides", ())))
    assert len(set(recipes)) == len(recipes)


@pytest.mark.parametrize("name", ["ablations", "embedding", "training_size"])
def test_studies_at_half_the_training_halve_all_of_it(name: str) -> None:
    """Of what is in their tables: ts-jepa-1 is not."""
    study, settings = tomllib.loads((STUDIES[0].parent / f"{name}.toml").read_text()), Settings()
    halved = dotted({key: of for key, of in study["common"].items() if key != "protocol"})
    assert halved.pop("hierarchy.flat_steps") == 1
    lengths = ("encoder.steps", "augment.steps", "actor.epochs")
    lengths += tuple(f"hierarchy.{level}_steps" for level in ("coarse", "medium", "low"))
    assert halved == {key: attrgetter(key)(settings) / 2 for key in lengths}


def test_rows_have_what_is_common_unless_they_say_otherwise() -> None:
    common = {"protocol": {"bracket": 0.1, "steps": 9}, "hierarchy": {"flat_steps": 1}}
    rows = [{"name": "a"}, {"name": "b", "strides": [8, 4, 2], "protocol": {"steps": 5}}]
    plain, other = load("study").rows_of({"methods": [], "common": common, "row": rows})
    assert plain == {"name": "a"} | common
    assert other == {
        "name": "b",
        "strides": [8, 4, 2],
        "protocol": {"bracket": 0.1, "steps": 5},
        "hierarchy": {"flat_steps": 1},
    }
    assert load("study").rows_of({"methods": [], "row": rows}) == rows


def test_a_study_runs_what_rows_differ_in_and_shares_the_rest(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    study, ran = load("study"), []

    def pretended(*words: object) -> dict[str, object]:
        ran.append([str(word) for word in words])
        return {"health": {}, "methods": {}}

    monkeypatch.setattr(study, "hjepa", pretended)
    rows = [
        {"name": "plain"},
        {"name": "long", "encoder": {"steps": 7}},
        {"name": "other strides", "strides": [16, 4, 1]},
        {"name": "measured otherwise", "protocol": {"curve_devices": 8}, "flat": [2, 3]},
        {"name": "raw frames", "encoder": {"method": "supervised"}},
        {"name": "another law", "control": {"gains_n": [-60.0, -35.0, -110.0, -8.0]}},
        {"name": "nothing hardened", "augment": {"strength": 0.0}},
    ]
    for row in rows:
        study.measure(row, 3, ["hjepa"], tmp_path)

    def used(stage: str, flag: str) -> list[str]:
        return [words[words.index(flag) + 1] for words in ran if words[0] == stage]

    *plain, law, augmented = used("collect", "--out")
    assert set(plain) == {augmented} != {law}
    encoders, levels = used("train-encoder", "--out"), used("train-hierarchy", "--out")
    *encoders, raw, law, augmented = encoders
    assert encoders == [encoders[0], encoders[1], encoders[0], encoders[0]]
    assert len({raw, law, augmented, *encoders}) == 5
    assert len(set(levels)) == 7 and levels[3] == levels[0]
    assert used("train-hierarchy", "--encoder") == [*encoders, *[levels[0]] * 2, law, augmented]
    strides = [[word for word in words if word.startswith("--h=")] for words in ran]
    assert [h for words, h in zip(ran, strides, strict=True) if words[0] == "train-hierarchy"] == [
        *([], [], ["--h=16"], []),
        *(["--h=2"], ["--h=3"], [], []),
    ]
    assert used("eval", "--checkpoint") == [*levels[:6], raw, *levels[6:]]
    assert used("eval", "--methods") == [
        *(*["hjepa"] * 4, "ts-jepa-2", "ts-jepa-3"),
        *["hjepa"] * 3,
    ]
    assert len(set(used("eval", "--out"))) == 9

    def told(stage: str, setting: str) -> int:
        """How many of a stage's runs are told of a setting."""
        return sum(setting in Path(config).read_text() for config in used(stage, "--config"))

    # What is only measured otherwise is not trained again: no stage sees the settings of another.
    assert (told("train-hierarchy", "curve_devices"), told("eval", "curve_devices")) == (0, 3)
    assert told("collect", "strength") == 0
    for stage in ("collect", "train-encoder", "train-hierarchy", "eval"):
        assert told(stage, "gains_n") == 1, stage
    assert [told(stage, "strength") for stage in ("train-encoder", "train-hierarchy")] == [1, 1]
    assert {words[words.index("--seed") + 1] for words in ran} == {"3"}


def test_single_levels_with_the_actors_of_two_models_are_two(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    study, made = load("study"), dict[str, set[str]]()

    def pretended(*words: object) -> dict[str, object]:
        if words[0] == "train-hierarchy":
            encoder, out = (str(words[words.index(flag) + 1]) for flag in ("--encoder", "--out"))
            made.setdefault(out, set()).add(encoder)
        return {"health": {}, "methods": {}}

    monkeypatch.setattr(study, "hjepa", pretended)
    for strides in ([4, 2, 1], [8, 2, 1]):
        row = {"name": str(strides), "strides": strides, "flat": [2]}
        study.measure(row, 0, ["hjepa"], tmp_path)
    assert len(made) == 4 and all(len(encoders) == 1 for encoders in made.values())


def test_intervals_of_a_study_are_students_over_seeds() -> None:
    over_seeds = load("study").over_seeds
    values = [170.0, 174.0, 181.0]
    low, high = stats.t.interval(0.95, 2, np.mean(values), stats.sem(values))
    assert over_seeds(values, 1) == f"175.0 ({low:.1f} – {high:.1f})"
    assert over_seeds([3.0], 2, [1.0, 4.0]) == "3.00 (1.00 – 4.00)"
    assert over_seeds([], 2) == "–"


def test_a_study_of_sizes_is_drawn(tmp_path: Path) -> None:
    study = load("study")
    windows = {"1-20": 0.006, "81-100": 0.003}

    def result(r2: float) -> dict[str, object]:
        entry = {
            "nmae_windows": windows,
            "nmae_windows_ci95": {window: [0.0, 1.0] for window in windows},
            "tolerance_gap_steps": 180.0,
            "tolerance_gap_ci95": [170.0, 190.0],
            "tolerance_p": 0.0105,
            "tolerance_p_ci95": [0.009, 0.012],
        }
        health = {"probe_r2": dict.fromkeys(study.PROBES, r2), "actor_nrmse": 0.06}
        return {"health": health, "methods": {"hjepa": entry}}

    measured = {"64": {0: result(0.97)}, "256": {0: result(0.99)}}
    study.write(measured, tmp_path / "embedding", "Values of an embedding")
    assert (tmp_path / "embedding.png").stat().st_size > 10_000
    probes, errors = study.size_figure(measured, "Values of an embedding").axes
    assert [line.get_label() for line in probes.lines] == list(study.PROBES.values())
    assert all(list(line.get_xdata()) == [64, 256] for line in probes.lines + errors.lines)
    assert list(probes.lines[0].get_ydata()) == [0.97, 0.99]
    assert probes.get_xlabel() == "Values of an embedding"
    assert not probes.collections  # one seed has no interval over trainings
    twice = {size: {0: of[0], 1: of[0]} for size, of in measured.items()}
    assert len(study.size_figure(twice, "n").axes[0].collections) == len(study.PROBES)
