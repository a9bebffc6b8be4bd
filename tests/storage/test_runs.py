"""Run directories: never overwritten, taken up after an interruption, repeated when finished."""

import csv
import json
import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hjepa_cli.config.settings import load_settings
from hjepa_cli.errors import DataError, LockedError, StorageError, Unsealed, UsageError
from hjepa_cli.storage import runs
from hjepa_cli.storage.runs import Run, newest_run, read_config, read_result, to_toml

SETTINGS = load_settings().as_dict()


def changed(key: str, value: Any) -> dict[str, Any]:
    return load_settings(flags={key: value}).as_dict()


def run_elsewhere(code: str) -> subprocess.CompletedProcess[str]:
    """Run code in another process in the current directory."""
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        env=os.environ | {"PYTHONPATH": str(Path(runs.__file__).parents[2])},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def as_of_schema(number: int, directory: Path) -> None:
    """Take from a run's records what versions up to this schema had not."""
    recorded = json.loads((directory / "environment.json").read_text()) | {"schema": number}
    later = ["settings"] if number == 2 else ["settings", "schema", "inputs"]
    kept = {key: value for key, value in recorded.items() if key not in later}
    (directory / "environment.json").write_text(json.dumps(kept))


@pytest.fixture(autouse=True)
def in_an_empty_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_new_runs_count_on() -> None:
    for number in (1, 2):
        with Run.create("eval", None, SETTINGS) as run:
            assert run.directory == Path("runs/eval") / f"{number:04d}"
            assert run.result is None and not run.resumed
    with Run.create("scale", None, SETTINGS) as run:
        assert run.directory == Path("runs/scale/0001")


def test_what_a_run_leaves() -> None:
    with Run.create("eval", Path("out"), SETTINGS) as run:
        run.metric({"epoch": 1, "loss": 0.5, "note": None})
        run.metric({"epoch": 2, "loss": np.float64(0.1), "note": "a, b"})
        run.event("epoch", loss=np.float32(0.5), r2=float("nan"), path=Path("x"))
        assert run.path("model.safetensors") == Path("out/model.safetensors")
        returned = run.finish({"score": np.float64(0.5), "nmae": np.array([1.0, np.nan])})
    assert returned == {"score": 0.5, "nmae": [1.0, None]} == read_result(Path("out"))
    with open("out/metrics.csv", newline="") as file:
        assert list(csv.reader(file)) == [
            ["epoch", "loss", "note"],
            ["1", "0.5", ""],
            ["2", "0.1", "a, b"],
        ]
    events = [json.loads(line) for line in Path("out/events.jsonl").read_text().splitlines()]
    assert [event["event"] for event in events] == ["started", "epoch"]
    assert events[0]["time"] <= events[1].pop("time")
    assert events[1] == {"event": "epoch", "loss": 0.5, "r2": None, "path": "x"}
    environment = json.loads(Path("out/environment.json").read_text())
    assert environment["stage"] == "eval" and environment["preset"] == "default"
    assert environment["versions"]["numpy"] == np.__version__


def test_metrics_hold_no_time_host_or_path() -> None:
    rows = [{"epoch": 1, "loss": 1 / 3}, {"epoch": 2, "loss": 1e-9}]
    for name in ("a", "b"):
        with Run.create("eval", Path(name), SETTINGS) as run:
            for row in rows:
                run.metric(row)
    assert Path("a/metrics.csv").read_bytes() == Path("b/metrics.csv").read_bytes()


def test_metric_rows_keep_their_columns() -> None:
    with Run.create("eval", Path("out"), SETTINGS) as run:
        run.metric({"epoch": 1, "loss": 0.5})
        with pytest.raises(ValueError, match="columns"):
            run.metric({"epoch": 2, "score": 0.5})
        with pytest.raises(ValueError, match="columns"):
            run.metric({"loss": 0.5, "epoch": 2})


@pytest.mark.parametrize("preset", ["default", "paper", "gym", "smoke"])
def test_config_reproduces_the_settings(preset: str) -> None:
    """``--config runs/…/config.toml`` asks for the same run again."""
    settings = load_settings(preset).as_dict()
    with Run.create("eval", Path("out"), settings):
        pass
    again = load_settings(config=Path("out/config.toml")).as_dict()
    assert again | {"preset": preset} == settings  # also what is off there, and on by default
    assert read_config(Path("out")) == {key: settings[key] for key in settings if key != "preset"}


OFF = {
    "augment.frames_within_s": 0.0,
    "augment.force_weight": 0.0,
    "augment.force_steps": 60,
    "augment.shift_down_px": 0.0,
    "augment.rotation_share": 0.25,
    "augment.rectangles": 1,
    "encoder.photometric": "none",
    "augment.strength": 0.0,
    "control.gains_n": [],
    "control.ceiling_gains_n": [],
}


def test_what_was_turned_off_stays_off() -> None:
    """Though it is on by default, or tuned, and settings say nothing of what is off."""
    off = load_settings(flags=OFF).as_dict()
    with Run.create("eval", Path("out"), off):
        pass
    with Run.create("eval", Path("out"), off) as run:
        assert run.resumed
    assert runs.load_recorded("default", Path("out")).as_dict() == off
    said = [
        r"augment\.strength = 0\.0, not 1\.0",
        r"control\.gains_n = \[\], not \[-130",
        r"encoder\.photometric = 'none', not 'affine'",
    ]
    with pytest.raises(UsageError, match=".*".join(said)):
        Run.create("eval", Path("out"), SETTINGS)
    with Run.create("eval", Path("other"), SETTINGS):
        pass
    with pytest.raises(UsageError, match=r"control\.gains_n = \[-130.*, not \[\]"):
        Run.create("eval", Path("other"), off)


def test_older_records_mean_off_where_they_say_nothing() -> None:
    """There was no other light, no worse picture and no tuned law before there were settings."""
    off = load_settings(flags=OFF)
    with Run.create("eval", Path("out"), off.as_dict()):
        pass
    config = Path("out/config.toml")
    text = re.sub(r'photometric = "none"\n', "", config.read_text())
    text = re.sub(r"\n\[(augment|control)\]\n(\w+ = .*\n)+", "", text)
    assert not re.search("photometric|strength|gains_n", text)
    config.write_text(text)
    as_of_schema(2, Path("out"))
    assert runs.load_recorded("default", Path("out")) == off
    with pytest.warns(Unsealed), Run.create("eval", Path("out"), off.as_dict()) as run:
        assert run.resumed


def test_toml_of_awkward_values() -> None:
    import tomllib

    values = {
        "text": 'a "quoted" \\ back\nslash λ',
        "small": 1e-9,
        "large": 1e22,
        "flag": True,
        "section": {"list": (1, 2), "mixed": [0.5, "x"], "empty": []},
    }
    expected = values | {"section": {"list": [1, 2], "mixed": [0.5, "x"], "empty": []}}
    assert tomllib.loads(to_toml(values)) == expected


def test_a_finished_run_is_repeated_not_redone() -> None:
    with Run.create("eval", Path("out"), SETTINGS) as run:
        run.metric({"epoch": 1})
        run.finish({"score": 0.5})
    before = {path: path.read_bytes() for path in Path("out").iterdir()}
    with Run.create("eval", Path("out"), SETTINGS) as run:
        assert run.result == {"score": 0.5}
    other = r"a finished run with other settings: protocol\.steps = 3000, not 999"
    with pytest.raises(UsageError, match=other):
        Run.create("eval", Path("out"), changed("protocol.steps", 999))
    assert {path: path.read_bytes() for path in Path("out").iterdir()} == before


def test_a_finished_run_does_not_pretend_to_have_done_what_it_was_not_asked_for() -> None:
    Run.create("scale", Path("out"), SETTINGS, {"verify": False}).close()
    with Run.create("scale", Path("out"), SETTINGS, {"verify": True}) as run:  # still to be done
        run.finish({"verify": []})
    for asked in (True, False):
        with Run.create("scale", Path("out"), SETTINGS, {"verify": asked}) as run:
            assert run.result == {"verify": []}
    with pytest.raises(UsageError, match="out holds a run finished without --remeasure") as caught:
        Run.create("scale", Path("out"), SETTINGS, {"verify": True, "remeasure": True})
    assert "--out" in (caught.value.hint or "")


@pytest.mark.parametrize("finished", [False, True])
def test_a_run_with_other_flags_is_not_the_one_that_is_asked_for(finished: bool) -> None:
    """But for those that ask for more of the same, or for a figure of it."""
    trace = runs.describe_input(Path("trace"), "0" * 64)
    given = {"tolerance_steps": 80.0, "delivery": None, "trace": trace, "figure": False}
    with Run.create("scale", Path("out"), SETTINGS, given) as run:
        if finished:
            run.finish({})
    for same in ({"tolerance_steps": 80, "figure": True}, {"of another version": 3}):
        Run.create("scale", Path("out"), SETTINGS, given | same).close()
    other = {
        "tolerance_steps = 80.0, not 40.0": {"tolerance_steps": 40.0},
        "tolerance_steps = 80.0, not None": {"tolerance_steps": None},
        "delivery = None, not 0.5": {"delivery": 0.5},
        "trace = '00.*, not '11": {"trace": trace | {"sha256": "1" * 64}},
        "trace = '00.*, not None": {"trace": None},
    }
    for says, changes in other.items():
        with pytest.raises(UsageError, match=says):
            Run.create("scale", Path("out"), SETTINGS, given | changes)


def test_an_unfinished_run_is_taken_up_again() -> None:
    with Run.create("eval", Path("out"), SETTINGS) as run:
        for epoch in range(5):
            run.metric({"epoch": epoch, "loss": 0.5})
            if epoch == 2:
                saved = run.metrics
        uninterrupted = Path("out/metrics.csv").read_bytes()
    with Run.create("eval", Path("out"), SETTINGS) as run:
        assert run.resumed and run.result is None
        run.metrics = saved
        for epoch in range(3, 5):
            run.metric({"epoch": epoch, "loss": 0.5})
        assert Path("out/metrics.csv").read_bytes() == uninterrupted
        run.metrics = ""
        run.metric({"other": 1})
    assert Path("out/metrics.csv").read_text() == "other\n1\n"
    assert '"resumed"' in Path("out/events.jsonl").read_text()


def test_lines_cut_by_a_kill_are_dropped() -> None:
    with Run.create("eval", Path("out"), SETTINGS) as run:
        run.metric({"epoch": 1, "loss": 0.5})
        run.event("odd", text="line\u2028separator")
    with open("out/metrics.csv", "a") as metrics, open("out/events.jsonl", "a") as events:
        metrics.write("2,0.")
        events.write('{"time": 17')
    with Run.create("eval", Path("out"), SETTINGS) as run:
        run.metric({"epoch": 2, "loss": 0.25})
    assert Path("out/metrics.csv").read_text() == "epoch,loss\n1,0.5\n2,0.25\n"
    lines = Path("out/events.jsonl").read_text().split("\n")[:-1]
    assert [json.loads(line)["event"] for line in lines] == ["started", "odd", "resumed"]


def test_an_unfinished_run_keeps_its_settings() -> None:
    with Run.create("eval", Path("out"), SETTINGS):
        pass
    with pytest.raises(UsageError, match=r"collect\.steps = 160, not 50") as caught:
        Run.create("eval", Path("out"), changed("collect.steps", 50))
    assert "--out" in (caught.value.hint or "")
    with Run.create("eval", Path("out"), SETTINGS) as run:  # the refusal gave the lock back
        assert run.resumed


def test_a_run_killed_before_its_config_starts_anew() -> None:
    Path("out").mkdir()
    Path("out/.lock").touch()
    Path("out/environment.json").write_text("{}")
    Path("out/.config.toml.999999999.tmp").write_text("pla")
    with Run.create("eval", Path("out"), SETTINGS) as run:
        assert not run.resumed
    assert sorted(os.listdir("out")) == [".lock", "config.toml", "environment.json", "events.jsonl"]


def test_foreign_directories_are_refused_untouched() -> None:
    Path("out").mkdir()
    Path("out/thesis.tex").write_text("precious")
    with pytest.raises(UsageError, match=r"not an hjepa run: it holds 'thesis\.tex'"):
        Run.create("eval", Path("out"), SETTINGS)
    assert os.listdir("out") == ["thesis.tex"]
    with Run.create("scale", Path("scale"), SETTINGS):
        pass
    with pytest.raises(UsageError, match="holds a run of 'scale', not of 'eval'"):
        Run.create("eval", Path("scale"), SETTINGS)


def test_unwritable_places_fail_before_any_work() -> None:
    Path("file").write_text("")
    for out in (Path("file"), Path("file/run")):
        with pytest.raises(StorageError, match="cannot write file") as caught:
            Run.create("eval", out, SETTINGS)
        assert "\n" not in caught.value.message and caught.value.exit_code == 74
    Path("runs").write_text("")
    with pytest.raises(StorageError, match="cannot write runs"):
        Run.create("eval", None, SETTINGS)


def test_damaged_records_are_data_errors() -> None:
    with Run.create("eval", Path("out"), SETTINGS) as run:
        run.finish({})
    Path("out/result.json").write_text("{")
    with pytest.raises(DataError, match=r"result\.json"):
        Run.create("eval", Path("out"), SETTINGS)
    Path("out/config.toml").write_text("= 3")
    with pytest.raises(DataError, match=r"config\.toml is not valid TOML"):
        Run.create("eval", Path("out"), SETTINGS)


def test_a_second_process_is_locked_out() -> None:
    code = """
        from pathlib import Path
        from hjepa_cli.errors import LockedError
        from hjepa_cli.config.settings import load_settings
        from hjepa_cli.storage.runs import Run
        try:
            Run.create("eval", Path("out"), load_settings().as_dict())
        except LockedError as error:
            print(error.message)
            raise SystemExit(error.exit_code)
    """
    with Run.create("eval", Path("out"), SETTINGS):
        with pytest.raises(LockedError):
            Run.create("eval", Path("out"), SETTINGS)
        second = run_elsewhere(code)
        assert second.returncode == 75, second.stderr
        assert second.stdout.startswith(
            f"another process is working in out: process {os.getpid()} on "
        )
    third = run_elsewhere(code)
    assert third.returncode == 0, third.stderr


def test_newest_run_is_finished_and_fits() -> None:
    assert newest_run("train-encoder") is None
    for age, (name, plant) in enumerate([("c", "gym"), ("b", "desktop"), ("a", "gym")]):
        with Run.create("train-encoder", Path("runs/train-encoder") / name, SETTINGS) as run:
            run.finish({"plant": plant})
        os.utime(run.path(runs.RESULT), (100 - age, 100 - age))  # as copying may leave them
    with Run.create("train-encoder", None, SETTINGS):
        pass  # unfinished
    assert newest_run("train-encoder") == Path("runs/train-encoder/a")
    is_desktop = lambda directory: read_result(directory)["plant"] == "desktop"  # noqa: E731
    assert newest_run("train-encoder", is_desktop) == Path("runs/train-encoder/b")
    assert newest_run("train-encoder", lambda _: False) is None
    assert newest_run("eval") is None


def test_a_run_without_a_time_of_its_own_has_that_of_its_file() -> None:
    for name, events in (("a", ""), ("b", "no json\n"), ("c", '{"time": "late"}\n')):
        with Run.create("train-encoder", Path("runs/train-encoder") / name, SETTINGS) as run:
            run.finish({})
        os.utime(run.path(runs.RESULT), (200 - ord(name), 200 - ord(name)))  # a is the newest
        run.path(runs.EVENTS).write_text(events)
    assert newest_run("train-encoder") == Path("runs/train-encoder/a")


def test_runs_of_preset_smoke_are_nobody_s_newest() -> None:
    """They have learned nothing; who works with that preset wants them."""
    for name, preset in (("trained", "default"), ("smoked", "smoke")):
        settings = load_settings(preset).as_dict()
        with Run.create("train-encoder", Path("runs/train-encoder") / name, settings) as run:
            run.finish({})
    trained, smoked = (Path("runs/train-encoder") / name for name in ("trained", "smoked"))
    assert newest_run("train-encoder", preset="default") == trained
    assert newest_run("train-encoder", preset="smoke") == smoked
    assert runs.finished_runs("train-encoder", preset="gym") == [trained]
    assert runs.finished_runs("train-encoder", preset="smoke") == [smoked, trained]


def test_a_result_is_written_after_all_else_is_on_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """A power loss must not leave a finished run with half of its metrics."""
    synced: list[str] = []
    fsync = os.fsync

    def traced(handle: int) -> None:
        synced.append(Path(os.readlink(f"/proc/self/fd/{handle}")).name)
        fsync(handle)

    with Run.create("eval", Path("out"), SETTINGS) as run:
        run.metric({"epoch": 1})
        monkeypatch.setattr(os, "fsync", traced)
        run.finish({"score": 0.5})
    result = next(name for name in synced if name.startswith(f".{runs.RESULT}"))
    assert {runs.METRICS, runs.EVENTS} <= set(synced[: synced.index(result)])


def test_what_an_older_version_had_not_is_as_its_preset_says() -> None:
    """Else no run would outlive a new setting, and the hint would lead in a circle."""
    settings = load_settings("smoke").as_dict()
    with Run.create("eval", Path("out"), settings):
        pass
    config = Path("out/config.toml")
    lines = config.read_text().splitlines(keepends=True)
    older = [line for line in lines if not line.startswith(("plant_spread", "bootstrap"))]
    assert len(older) == len(lines) - 2
    config.write_text("".join(older))
    as_of_schema(2, Path("out"))
    with pytest.warns(Unsealed), Run.create("eval", Path("out"), settings) as run:
        assert run.resumed
    other = load_settings("smoke", flags={"protocol.bootstrap": 7}).as_dict()
    with pytest.raises(UsageError, match=r"protocol\.bootstrap = \d+, not 7"):
        Run.create("eval", Path("out"), other)
    config.write_text("".join(older) + "[strange]\nnew = 1\n")
    with pytest.raises(UsageError, match=r"other settings: strange\.new = 1, not None$"):
        Run.create("eval", Path("out"), settings)


def test_worse_pictures_that_nobody_makes_have_no_differences() -> None:
    """Where they are off, on either side, how they would be made says nothing."""
    on, weaker, off = (
        changed("augment.strength", strength) | {"preset": "default"}
        for strength in (1.0, 0.5, 0.0)
    )
    spelled = off | {"augment": {"strength": 0.0, "steps": 7, "gain": 0.1}}
    assert runs.differences(off, spelled) == runs.differences(spelled, off) == []
    assert runs.differences(on, off) == ["augment.strength = 1.0, not 0.0"]
    assert runs.differences(off, on) == ["augment.strength = 0.0, not 1.0"]
    weaker["augment"]["gain"] = 0.1
    others = ["augment.gain = 0.35, not 0.1", "augment.strength = 1.0, not 0.5"]
    assert runs.differences(on, weaker) == others


def test_a_run_of_schema_1_goes_on(tmp_path: Path) -> None:
    """It did not say what it was given: nothing to compare."""
    with Run.create("eval", Path("out"), SETTINGS):
        pass
    as_of_schema(1, Path("out"))
    given = {"dataset": runs.describe_input(tmp_path, "0" * 64)}
    with pytest.warns(Unsealed), Run.create("eval", Path("out"), SETTINGS, given) as run:
        assert run.resumed


def test_a_damaged_run_does_not_hide_the_others() -> None:
    for name in ("a", "b", "c"):
        with Run.create("train-encoder", Path("runs/train-encoder") / name, SETTINGS) as run:
            run.finish({})
    Path("runs/train-encoder/c/config.toml").write_text("= 3")
    Path("runs/train-encoder/b/config.toml").unlink()
    plant = lambda directory: read_config(directory)["plant"] == "desktop"  # noqa: E731
    assert newest_run("train-encoder", plant) == Path("runs/train-encoder/a")
    other = lambda directory: read_config(directory)["no such"]  # noqa: E731
    assert newest_run("train-encoder", other) is None


def test_runs_of_before_there_was_a_warm_up_are_scored_from_the_start() -> None:
    with Run.create("eval", Path("old"), SETTINGS):
        pass
    config = Path("old") / runs.CONFIG
    text = (
        config.read_text()
        .replace("warmup_steps = 1000\n", "")
        .replace("steps = 3000", "steps = 900")
    )
    config.write_text(text)
    as_of_schema(2, Path("old"))
    protocol = runs.load_recorded(None, Path("old")).protocol
    assert (protocol.warmup_steps, protocol.steps) == (0, 900)
