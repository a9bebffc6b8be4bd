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
        entry["nmae_every_step"] = 0.01 * (number + 1)
        entry["nmae_every_step_ci95"] = [0.008 * (number + 1), 0.012 * (number + 1)]
        found[name] = entry
    return found


def drawn(given):
    return comparison_figure(given, acceptable_score=0.62, step_s=1e-3, title="a title")


def panels(figure):
    """Error at every step, error later, bits, score at every step, score later."""
    assert len(figure.axes) == 5
    return figure.axes


def test_it_is_two_columns_wide_and_equal_byte_for_byte(tmp_path):
    first = figures.save(drawn(entries()), tmp_path / "first.png").read_bytes()
    assert figures.save(drawn(entries()), tmp_path / "second.png").read_bytes() == first
    assert drawn(entries()).get_figwidth() == TWO_COLUMNS_IN[0]


def test_every_method_is_named_once_and_drawn_where_it_was_measured():
    given = entries()
    figure = drawn(given)
    [legend] = figure.legends
    named = [text.get_text() for text in legend.get_texts()]
    assert named == ["hjepa", "ts-jepa-1", "supervised-2", "oracle"]
    _, later, bits, _, score = panels(figure)
    errors = {line.get_label(): line for line in later.lines}
    assert "optimal" not in errors  # makes none
    assert errors["hjepa"].get_ydata() == pytest.approx(given["hjepa"]["nmae"])
    gaps = [point["d"] for point in given["oracle"]["gap_curve"]]
    scores = {line.get_label(): line for line in score.lines}
    assert scores["oracle"].get_xdata() == pytest.approx(np.array(gaps, float))  # in ms
    widths = {
        name.get_text(): bar.get_width()
        for name, bar in zip(bits.get_yticklabels(), bits.patches, strict=True)
    }
    assert widths["hjepa"] == given["hjepa"]["bits_per_transmission"]
    assert "optimal" not in widths


def test_what_an_older_version_did_not_measure_is_left_out():
    given = entries()
    for key in ("nmae_every_step", "nmae_every_step_ci95"):
        del given["hjepa"][key]
    at_once, later, *_ = panels(drawn(given))
    assert len(at_once.containers) == 2  # ts-jepa-1 and supervised-2; the others make no error
    assert "hjepa" in {line.get_label() for line in later.lines}


def test_all_methods_differ_in_colour_or_marker():
    styles = [figures.method_style(name, list(METHODS)) for name in METHODS]
    assert len({(style.colour, style.marker, style.hollow) for style in styles}) == len(
        list(METHODS)
    )
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
