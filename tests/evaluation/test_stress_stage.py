"""``eval --stress``: a row is a simulation under its conditions, and ends up in the report."""

import numpy as np
import pytest

from hjepa_cli.api import load_model
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.evaluation.protocol import Point
from hjepa_cli.core.evaluation.simulator import Block, Simulator
from hjepa_cli.core.plants.stress import under
from hjepa_cli.errors import UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import evaluate, report, stressing
from hjepa_cli.storage.runs import Run

ROWS = ("noise=64+light=0.5", "actuation=20")


def options(*rows: str):
    changes = {"stress": rows, "methods": ("hjepa", "optimal")}
    return load_settings("smoke", flags=changes)


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    out = tmp_path_factory.mktemp("stress") / "run"
    quiet = Screen(quiet=True)
    return out, evaluate.run(options(*ROWS), quiet, checkpoint="desktop-h4m2l1", out=out)


def test_a_row_is_a_simulation_under_its_conditions(evaluated) -> None:
    _, result = evaluated
    measured, model = result["stress"], load_model("desktop-h4m2l1")
    assert measured["gaps"] == [20, 80, 160] and measured["conditions"] == list(ROWS)
    points = tuple(Point("gap", float(gap)) for gap in measured["gaps"])
    teacher = Simulator(options(*ROWS), None)
    best = Block("optimal", (Point("gap", 1.0),), 0, 8, True).compute(teacher, lambda steps: None)
    rows = [measured["methods"]["hjepa"]["nominal"]]
    rows += [row["points"] for row in measured["methods"]["hjepa"]["rows"]]
    scores = []
    for text, row in zip(("", *ROWS), rows, strict=True):
        simulator = Simulator(under(options(), text), model)
        outcome = Block("hjepa", points, 0, 8).compute(simulator, lambda steps: None)
        scores.append(outcome.score.mean(axis=1))
        expected = scores[-1] / best.score.mean()
        np.testing.assert_allclose([point["score"] for point in row], expected, atol=1e-12)
        relative = [point["relative"] for point in row]
        np.testing.assert_allclose(relative, scores[-1] / scores[0], atol=1e-12)
    assert scores[1][0] < 0.9 * scores[0][0], "noise of 64 grey levels hurts"
    means = measured["methods"]["hjepa"]["means"]
    expected = np.mean(scores[1:], axis=0) / scores[0]
    np.testing.assert_allclose([mean["relative"] for mean in means], expected, atol=1e-12)


def test_no_curves_are_planned_where_rows_are_measured(monkeypatch) -> None:
    monkeypatch.setattr(evaluate, "plan_curves", lambda *_, **__: pytest.fail("curves"))
    planned = evaluate.plan(options(*ROWS), checkpoint="desktop-h4m2l1")
    assert "under 2 conditions and none" in planned.work[0]


def test_rows_that_were_measured_are_not_measured_again(evaluated, tmp_path, monkeypatch) -> None:
    _, result = evaluated
    settings, quiet = options(*ROWS), Screen(quiet=True)
    models = evaluate.open_measurable(settings, quiet, "desktop-h4m2l1", None)
    asked: list[str] = []
    start = stressing.start_points

    def counted(runner, method, *more):
        asked.append(method)
        return start(runner, method, *more)

    monkeypatch.setattr(stressing, "start_points", counted)
    with Run.create("eval", tmp_path / "again", settings.as_dict(), {}) as record:
        kept = stressing.measure_stress(models, quiet, record)
        assert len(asked) == 6
        assert stressing.measure_stress(models, quiet, record) == kept
        assert len(asked) == 6
    assert kept["methods"] == result["stress"]["methods"]


def test_the_report_has_the_table_and_the_figure(evaluated, tmp_path) -> None:
    out, _ = evaluated
    report.run(Screen(quiet=True), [out], out=tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    assert all(row in text for row in (*ROWS, "nominal", "mean of these", "<img"))


@pytest.mark.parametrize(("preset", "counts"), [("default", (42, 116)), ("quadrotor", (37, 105))])
def test_sets_of_conditions_are_those_that_the_plant_has(preset, counts) -> None:
    every = [load_settings(preset, flags={"stress": (name,)}) for name in ("audit", "all")]
    assert tuple(len(stressing.rows_of(settings)) for settings in every) == counts


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ("lihgt=0.5", "lihgt"),
        ("light=9", "light=9"),
        ("viscous", "--stress viscous=0.5: "),
        ("length=0.9", "--stress length=0.9: "),
    ],
)
def test_what_cannot_be_measured_is_refused_before_anything_is_written(row, says, tmp_path) -> None:
    lacking = says.startswith("--stress")
    preset, model = ("quadrotor", None) if lacking else ("smoke", "desktop-h4m2l1")
    settings = load_settings(preset, flags={"stress": (row,), "methods": ("oracle",)})
    with pytest.raises(UsageError, match=says):
        evaluate.run(settings, Screen(quiet=True), checkpoint=model, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_flagged_packets_are_counted_in_curves_and_rows(tmp_path) -> None:
    changes = {"protocol.false_alarm": 0.05, "methods": ("hjepa",), "protocol.gaps": (1, 5)}
    quiet = Screen(quiet=True)
    small = load_settings("smoke", flags=changes)
    evaluated = evaluate.run(small, quiet, checkpoint="desktop-h4m2l1", out=tmp_path / "curves")
    every, five = evaluated["methods"]["hjepa"]["gap_curve"]
    assert 0 <= every["flagged"] < 0.2 and 0 <= five["flagged"] < 0.2
    black = load_settings("smoke", flags=changes | {"stress": ("black=1",)})
    found = evaluate.run(black, quiet, checkpoint="desktop-h4m2l1", out=tmp_path / "stress")
    entry = found["stress"]["methods"]["hjepa"]
    assert entry["rows"][0]["points"][0]["flagged"] == 1.0 > entry["nominal"][0]["flagged"]
    report.run(quiet, [tmp_path / "stress"], out=tmp_path / "report.html")
    assert "flagged" in (tmp_path / "report.html").read_text()
