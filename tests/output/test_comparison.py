"""The paper's Fig. 3: every method is in it, nothing is drawn that was not measured."""

import copy
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("matplotlib")
from hjepa_cli.config.checks import compared_methods
from hjepa_cli.output import figures
from hjepa_cli.output.comparison import comparison_figure, trainings_figure
from hjepa_cli.output.looks import PAGE_IN, Looks
from hjepa_cli.plugins import METHODS
from hjepa_cli.storage.zoo import zoo_directory


def entries(methods=("hjepa", "ts-jepa-1", "supervised-2", "optimal", "oracle")):
    """The zoo's entries under these names, with an error that differs from method to method."""
    measured = json.loads((zoo_directory() / "desktop-h4m2l1" / "curves.json").read_text())
    found = {}
    for number, name in enumerate(methods):
        entry = copy.deepcopy(measured["methods"].get(name, measured["methods"]["hjepa"]))
        if name == "optimal":  # as under the teacher's law
            exact = measured["methods"]["oracle"]
            entry |= {key: exact[key] for key in exact if key.startswith("nmae")}
        entry["nmae_every_step"] = 0.01 * (number + 1)
        entry["nmae_every_step_ci95"] = [0.008 * (number + 1), 0.012 * (number + 1)]
        found[name] = entry
    return found


def drawn(given):
    asked = Looks(title="a title")
    return comparison_figure(given, acceptable_score=0.62, step_s=1e-3, asked=asked)


def marks(axes, methods):
    """By method the place and the interval of its mark in a panel of rows."""
    found = {}
    for line, _, (interval,) in axes.containers:
        (place,), (row,) = line.get_xdata(), line.get_ydata()
        found[methods[int(row)]] = place, interval.get_segments()[0][:, 0].tolist()
    return found


def test_it_is_two_columns_wide_and_equal_byte_for_byte(tmp_path):
    first = figures.save(drawn(entries()), tmp_path / "first.png").read_bytes()
    assert figures.save(drawn(entries()), tmp_path / "second.png").read_bytes() == first
    assert drawn(entries()).get_figwidth() == PAGE_IN


def test_every_method_is_a_row_and_drawn_where_it_was_measured():
    """Errors by window with their intervals; bits that are all equal are a line of text."""
    given = entries()
    figure = drawn(given)
    *errors, score = figure.axes
    shown = [label.get_text() for label in errors[0].get_yticklabels()]
    assert shown == ["hjepa", "ts-jepa-1", "supervised-2"]  # the others make no error
    windows = ["1-20", "21-40", "41-80", "81-100"]
    assert [axes.get_title() for axes in errors] == [
        "error at\nevery step",
        *(f"error after\n{window.replace('-', '–')} ms" for window in windows),
    ]
    assert marks(errors[0], shown)["hjepa"] == (0.01, pytest.approx([0.008, 0.012]))
    for window, axes in zip(windows, errors[1:], strict=True):
        for name, (place, interval) in marks(axes, shown).items():
            assert place == given[name]["nmae_windows"][window]
            assert interval == pytest.approx(given[name]["nmae_windows_ci95"][window])
    gaps = [point["d"] for point in given["oracle"]["gap_curve"]]
    scores = {line.get_label(): line for line in score.lines}
    assert scores["oracle"].get_xdata() == pytest.approx(np.array(gaps, float))  # in ms
    assert "optimal" not in scores
    assert "every method sends 2,064 bits per transmission" in figure.get_suptitle()
    assert "no error: optimal, oracle" in figure.legends[0].get_title().get_text()


def test_bits_that_differ_are_said_of_whom():
    given = entries()
    given["supervised-2"]["bits_per_transmission"] = 393_216
    said = drawn(given).get_suptitle()
    assert "(b) bits per transmission: 393,216 supervised-2; all others 2,064" in said


def test_what_an_older_version_did_not_measure_is_left_out():
    given = entries()
    for key in ("nmae_every_step", "nmae_every_step_ci95"):
        del given["hjepa"][key]
    at_once, later, *_ = drawn(given).axes
    assert len(at_once.containers) == 2  # ts-jepa-1 and supervised-2; the others make no error
    assert len(later.containers) == 3


def test_a_study_of_trainings_shows_tolerances_beside_errors():
    given = entries()
    figure = trainings_figure(given, step_s=20e-3)
    *_, gap, least = figure.axes
    shown = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert shown[-1] == "oracle"  # has tolerances, though no error
    for name, (place, interval) in marks(gap, shown).items():
        assert place == pytest.approx(20 * given[name]["tolerance_gap_steps"])
        assert interval == pytest.approx(20 * np.array(given[name]["tolerance_gap_ci95"]))
    assert marks(least, shown)["hjepa"][0] == pytest.approx(given["hjepa"]["tolerance_p"])


def test_an_interval_down_to_nothing_does_not_stretch_logarithmic_axes():
    """Student's over few trainings often is one, of errors and of p* alike."""
    given = entries()
    least, _ = trainings_figure(given, step_s=1e-3).axes[0].get_xlim()
    given["hjepa"]["nmae_every_step_ci95"] = [0.0, 0.012]
    given["ts-jepa-1"]["tolerance_p_ci95"] = [0.0, 1.0]
    every, *_, delivery = trainings_figure(given, step_s=1e-3).axes
    assert 0.3 * least < every.get_xlim()[0] < least
    assert delivery.get_xscale() == "log" and delivery.get_xlim()[0] > 1e-3


def test_all_methods_differ_in_colour_or_marker():
    styles = [figures.method_style(name, list(METHODS)) for name in METHODS]
    assert len({(style.colour, style.marker, style.hollow) for style in styles}) == len(
        list(METHODS)
    )
    assert len({style.colour for style in styles}) == len(styles)  # one colour each, everywhere
    assert len({style.marker + str(style.line) + str(style.hollow) for style in styles}) > 12
    assert set(compared_methods()) <= set(METHODS)


def test_eval_draws_it(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "hjepa_cli", "eval", "--figure", "--methods", "oracle,hold,hjepa",
         "--json", "--quiet"],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=300,
        env={"PYTHONPATH": str(Path(__file__).parents[2]), "PATH": "/usr/bin:/bin"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    written = [Path(path) for path in json.loads(done.stdout)["figures"]]
    assert [path.name for path in written] == [f"comparison.{kind}" for kind in figures.METADATA]
    assert all((tmp_path / path).stat().st_size > 1000 for path in written)
