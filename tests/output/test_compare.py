"""``hjepa compare``: means over trainings, paired differences, and what is not to be compared."""

import copy
import json
from pathlib import Path

import numpy as np
import pytest
from command_line import assert_one_line_error, open_shell
from scipy import stats

from hjepa_cli.config.settings import load_settings
from hjepa_cli.storage import seals
from hjepa_cli.storage.runs import Run, read_result
from hjepa_cli.storage.zoo import zoo_directory

ZOO = json.loads((zoo_directory() / "desktop-h4m2l1" / "curves.json").read_text())["methods"]
GAPS = {"hjepa": (170.0, 174.0, 181.0), "ts-jepa-4": (168.0, 175.0, 170.0)}
ERRORS = {"hjepa": (0.004, 0.005, 0.0048), "ts-jepa-4": (0.006, 0.0065, 0.0062)}


def entry(method, seed):
    """The zoo's, with the numbers above."""
    found = copy.deepcopy(ZOO[method])
    if method in GAPS:
        found["tolerance_gap_steps"] = GAPS[method][seed]
        found["tolerance_gap_ci95"] = [0.9 * GAPS[method][seed], 1.1 * GAPS[method][seed]]
        found["nmae_windows"]["1-20"] = ERRORS[method][seed]
        found["nmae"] = [value + 0.001 * seed for value in found["nmae"]]
        found["nmae_ci95"] = [[end + 0.001 * seed for end in ends] for ends in found["nmae_ci95"]]
    return found


def evaluated(training, methods=("hjepa", "ts-jepa-4", "oracle"), name=None, **changes):
    """A finished run of eval, of models that were trained with seed ``training``."""
    settings = load_settings().as_dict()
    for section in ("protocol", "collect"):
        settings[section] |= changes.pop(section, {})
    result = {
        "plant": "desktop",
        "seed": 0,
        "loop_version": 2,
        "acceptable_score": 0.62,
        "acceptable_lq_ratio": 0.8,
        "horizon": list(range(101)),
        "training_seeds": {name: training for name in methods if name != "oracle"},
        "methods": {name: entry(name, training or 0) for name in methods},
    }
    directory = Path("runs/eval") / (name or f"seed-{training}")
    with Run.create("eval", directory, settings) as record:
        record.finish(result | changes)
    return directory


def reseal(path, document):
    """Write a result that lies, under the right seal."""
    path.write_text(json.dumps(seals.sealed(document)))


@pytest.fixture
def shell(tmp_path, monkeypatch, capsys):
    return open_shell(tmp_path, monkeypatch, capsys)


def test_means_and_intervals_are_over_trainings(shell):
    for seed in range(3):
        evaluated(seed)
    document = shell("compare", "--json").document
    assert document["training_seeds"] == [0, 1, 2]
    for name, gaps in GAPS.items():
        found = document["methods"][name]
        assert found["tolerance_gap_steps"] == pytest.approx(np.mean(gaps))
        expected = stats.t.interval(0.95, 2, np.mean(gaps), stats.sem(gaps))
        assert found["tolerance_gap_ci95"] == pytest.approx(expected)
        middle = np.array(ZOO[name]["nmae"]) + 0.001
        half = stats.t.ppf(0.975, 2) * 0.001 / np.sqrt(3)
        assert np.array(found["nmae_ci95"]) == pytest.approx(middle[:, None] + [[-half, half]])
        assert found["n_trainings"] == 3
    oracle = document["methods"]["oracle"]  # one measurement, found three times
    assert oracle["n_trainings"] == 0
    assert oracle["tolerance_gap_ci95"] == ZOO["oracle"]["tolerance_gap_ci95"]


def test_differences_are_paired_within_trainings(shell):
    for seed in range(3):
        evaluated(seed)
    [found] = shell("compare", "--json").document["differences"]  # none over the oracle
    assert (found["method"], found["over"]) == ("hjepa", "ts-jepa-4")
    errors, gaps = (np.array([of["hjepa"], of["ts-jepa-4"]]) for of in (ERRORS, GAPS))
    paired = stats.ttest_rel(*errors).confidence_interval(0.95)
    assert found["nmae_windows"]["1-20"]["mean"] == pytest.approx(np.mean(errors[0] - errors[1]))
    assert found["nmae_windows"]["1-20"]["ci95"] == pytest.approx([paired.low, paired.high])
    ratio = np.exp(stats.ttest_rel(*np.log(gaps)).confidence_interval(0.95))
    assert found["tolerance_gap_ratio"]["ci95"] == pytest.approx(ratio)
    [turned] = shell("compare", "--methods", "ts-jepa-4,hjepa", "--json").document["differences"]
    assert turned["tolerance_gap_ratio"]["mean"] == pytest.approx(
        1 / found["tolerance_gap_ratio"]["mean"]
    )


def test_methods_of_one_training_may_lie_in_several_runs(shell):
    runs = [evaluated(seed, ("hjepa",), f"h-{seed}") for seed in range(2)]
    runs += [evaluated(seed, ("ts-jepa-4",), f"flat-{seed}") for seed in range(2)]
    document = shell("compare", *runs, "--json").document
    assert sorted(document["methods"]) == ["hjepa", "ts-jepa-4"]
    assert len(document["runs"]) == 4


def test_the_figure_has_every_method_and_its_band(shell):
    pytest.importorskip("matplotlib")
    for seed in range(2):
        evaluated(seed)
    document = shell("compare", "--figures", "f", "--format", "svg", "--json").document
    assert document["figures"] == ["f/trainings.svg"]
    drawn = (shell.directory / "f" / "trainings.svg").read_text()
    assert drawn.count("FillBetween") == 3 or drawn.count("PolyCollection") == 3  # of scores
    for name in document["methods"]:
        assert f"<!-- {name} -->" in drawn or f"<!-- ≈ {name} -->" in drawn, name
    title = ("--title", "five of them", "--labels", "hjepa=H-JEPA")
    shell("compare", "--figures", "f", "--format", "svg", *title)
    drawn = (shell.directory / "f" / "trainings.svg").read_text()
    assert "<!-- five of them -->" in drawn and "<!-- H-JEPA -->" in drawn
    with shell.untouched():
        assert_one_line_error(shell("compare", *title), 2, "none is drawn", "--figures")


@pytest.mark.parametrize(
    ("changes", "fragments"),
    [
        ({"plant": "gym"}, ("plant is 'desktop'", "'gym' in runs/eval/seed-1")),
        ({"loop_version": 1}, ("loop_version is 2", "1 in")),
        ({"protocol": {"steps": 250}}, ("protocol.steps is 3000", "250 in")),
        ({"horizon": [0, 1]}, ("horizon",)),
        ({"collect": {"x_m": 0.3}}, ("collect.x_m", "0.3 in")),
        ({"collect": {"start": [0.1, 0.2, 0.1, 0.2]}}, ("collect.start",)),
        (
            {"training_seeds": {"hjepa": 1, "ts-jepa-4": 2}},
            ("different seeds", "hjepa: 1, ts-jepa-4: 2"),
        ),
    ],
)
def test_what_was_not_measured_alike_is_refused_by_name(shell, changes, fragments):
    evaluated(0)
    evaluated(1, **changes)
    assert_one_line_error(shell("compare"), 65, *fragments)


def test_two_models_of_one_seed_are_refused(shell):
    evaluated(0)
    evaluated(1)
    evaluated(1, ("hjepa",), "again")
    assert shell("compare").code == 0  # the same numbers again are no contradiction
    other = evaluated(1, ("hjepa",), "other")
    document = json.loads((other / "result.json").read_text())
    document["methods"]["hjepa"] |= {"score": 0.5, "score_ci95": [0.4, 0.6]}
    reseal(other / "result.json", document)
    assert_one_line_error(shell("compare"), 65, "two measurements of hjepa", "training seed 1")


def test_seeds_of_draws_may_differ_between_trainings_only(shell):
    evaluated(0)
    evaluated(1, seed=1)
    assert shell("compare").code == 0
    evaluated(1, ("hjepa",), "again")
    assert_one_line_error(shell("compare"), 65, "seed is 0 in runs/eval/again, 1 in")


def test_every_method_needs_the_same_trainings(shell):
    evaluated(0)
    evaluated(1, ("hjepa", "oracle"))
    missing = shell("compare")
    assert_one_line_error(missing, 66, "ts-jepa-4 was not measured with training seed 1")
    assert shell("compare", "--methods", "hjepa,oracle").code == 0


def test_one_training_is_no_comparison(shell):
    evaluated(3, ("oracle",))
    assert_one_line_error(shell("compare"), 66, "needs two of them", "no model")


def test_nothing_to_compare(shell):
    missing = shell("compare")
    assert_one_line_error(missing, 66, "no finished run")
    assert "scale" not in missing.err
    assert_one_line_error(shell("compare", "--methods", "magic"), 2, "unknown method 'magic'")


def test_a_run_of_an_older_version_says_how_to_measure_it_again(shell):
    evaluated(0)
    old = evaluated(1)
    document = json.loads((old / "result.json").read_text())
    del document["training_seeds"]
    reseal(old / "result.json", document)
    outcome = shell("compare")
    assert_one_line_error(outcome, 65, "older version")
    assert "hjepa eval --config runs/eval/seed-1/config.toml --remeasure --out" in outcome.err


def test_the_order_is_that_of_the_methods_not_of_files(shell):
    for seed in range(2):
        evaluated(seed, ("oracle", "ts-jepa-4", "hjepa"))
    found = list(shell("compare", "--json").document["methods"])
    assert found == ["hjepa", "ts-jepa-4", "oracle"]


def test_methods_without_a_model_are_no_trainings(shell):
    for seed in range(2):
        evaluated(seed, ("hjepa",))
    evaluated(None, ("oracle",), "oracle", seed=7)
    document = shell("compare", "--json").document
    assert document["training_seeds"] == [0, 1]
    assert document["methods"]["oracle"]["n_trainings"] == 0
    assert document["methods"]["hjepa"]["n_trainings"] == 2
    assert_one_line_error(shell("compare", "--methods", "hjepa,optimal"), 66, "optimal was not")


def test_methods_choose_what_a_mixed_run_is_taken_for(shell):
    evaluated(0)
    evaluated(1, training_seeds={"hjepa": 1, "ts-jepa-4": 0})
    assert_one_line_error(shell("compare"), 65, "different seeds")
    assert shell("compare", "--methods", "hjepa,oracle").code == 0


def test_bounds_have_no_ratio_and_intervals_stay_in_range(shell):
    for seed, gap in enumerate((2.0, 320.0)):
        path = evaluated(seed) / "result.json"
        document = json.loads(path.read_text())
        document["methods"]["hjepa"] |= {
            "tolerance_gap_steps": gap,
            "tolerance_gap_ci95": [0.9 * gap, 1.1 * gap],
            "tolerance_gap_censored": seed == 1,
        }
        reseal(path, document)
    document = shell("compare", "--json").document
    low, high = document["methods"]["hjepa"]["tolerance_gap_ci95"]
    assert low == 0 < 161 < high
    assert document["methods"]["hjepa"]["tolerance_gap_censored"]
    assert document["differences"][0]["tolerance_gap_ratio"] is None


def test_a_training_that_no_packets_suffice_has_no_ratio(shell):
    """p* is 1 there, as of one that needs every packet, and D* is 0."""
    evaluated(0)
    path = evaluated(1) / "result.json"
    document = json.loads(path.read_text())
    document["methods"]["ts-jepa-4"] |= {
        "tolerance_gap_steps": 0.0,
        "tolerance_gap_ci95": [0.0, 0.0],
        "tolerance_p": 1.0,
        "tolerance_p_ci95": [1.0, 1.0],
    }
    reseal(path, document)
    [found] = shell("compare", "--json").document["differences"]
    assert found["tolerance_gap_ratio"] is None and found["tolerance_p_ratio"] is None


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        ("training_seeds", [1], "training_seeds"),
        ("training_seeds", {"hjepa": True, "ts-jepa-4": True}, "does not say with which seed"),
        ("methods", [], "methods"),
        ("methods", {"hjepa": None}, "method 'hjepa'"),
        ("horizon", [0], "over the horizon"),
    ],
)
def test_damaged_results_are_named(shell, key, value, reason):
    evaluated(0)
    path = evaluated(1) / "result.json"
    reseal(path, json.loads(path.read_text()) | {key: value})
    assert_one_line_error(shell("compare"), 65, "runs/eval/seed-1", reason)


def test_rollouts_of_one_training_are_the_same(shell):
    settings = load_settings().as_dict()
    for seed in range(2):
        evaluated(seed)
    first = read_result(Path("runs/eval/seed-1"))
    inputs = {"dataset": {"path": "data", "sha256": "f" * 64}}
    with Run.create("eval", Path("runs/eval/other"), settings, inputs) as record:
        record.finish(first)
    assert_one_line_error(shell("compare"), 65, "dataset is")
    settings["collect"]["clean_steps"] = 130
    with Run.create("eval", Path("runs/eval/seed-2"), settings) as record:
        record.finish(first | {"training_seeds": {"hjepa": 2, "ts-jepa-4": 2}})
    runs = [f"runs/eval/seed-{seed}" for seed in (0, 2)]
    assert_one_line_error(shell("compare", *runs), 65, "collect.clean_steps is 120")
