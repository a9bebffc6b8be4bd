"""Reports: one file that needs nothing else, and nothing in it that a name could smuggle in."""

import base64
import re
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from command_line import assert_one_line_error, open_shell

from hjepa_cli.config.settings import load_settings
from hjepa_cli.output import looks, page
from hjepa_cli.output.looks import COLUMN_IN, PAGE_IN
from hjepa_cli.plugins import METHODS
from hjepa_cli.stages import report
from hjepa_cli.storage import runs
from hjepa_cli.storage.runs import Run

pytest.importorskip("matplotlib")
from hjepa_cli.output import figures

EVIL = '<script>alert("x")</script>&'


class Reader(HTMLParser):
    """Tags and texts of a page; checks that every tag is closed."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.links, self.texts = [], [], [], []
        self.feed(text)
        assert not self.open, self.open

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.links += [value for name, value in attributes if name in ("src", "href")]
        assert not any(name.startswith("on") for name, _ in attributes)
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)


def entry(score):
    """One method of an evaluation, shaped as ``eval --json`` prints it."""
    curve = [
        {"score": score / gap, "ci95": [0.9 * score / gap, 1.1 * score / gap]} for gap in (1, 2, 8)
    ]
    return {
        "nmae": [0.01, 0.02, 0.03],
        "nmae_ci95": [[0.009, 0.011], [0.019, 0.021], [0.029, 0.031]],
        "nmae_windows": {"1-20": 0.025},
        "nmae_windows_ci95": {"1-20": [0.02, 0.03]},
        "score": score,
        "score_ci95": [score - 0.1, score + 0.1],
        "lq_ratio": 0.8,
        "bits_per_transmission": 2064,
        "gap_curve": [p | {"d": d} for p, d in zip(curve, (1, 2, 8), strict=True)],
        "delivery_curve": [p | {"p": 1 / d} for p, d in zip(curve, (1, 2, 8), strict=True)],
        "tolerance_gap_steps": 81.25,
        "tolerance_gap_ci95": [75.0, 90.5],
        "tolerance_gap_censored": False,
        "tolerance_p": 0.0125,
        "tolerance_p_ci95": [0.01, 0.02],
        "tolerance_p_censored": True,
        "n_curve_devices": 64,
        "n_devices": 256,
        "n_rollouts": 40,
    }


def finished(stage, result, metrics=(), name=None, inputs=None):
    settings, out = load_settings().as_dict(), Path("runs") / stage / name if name else None
    with Run.create(stage, out, settings, inputs) as record:
        for row in metrics:
            record.metric(row)
        record.finish(result)
        return record.directory


def evaluated(name=None, plant="desktop", **changes):
    methods = {"hjepa": entry(0.95), EVIL: entry(0.5)}
    document = {"plant": plant, "seed": 0, "checkpoint": f"m/{EVIL}", "methods": methods}
    return finished("eval", document | changes, name=name)


def scaled(**changes):
    rows = [
        {
            "snr_db": snr,
            "method": method,
            "bits_per_s": 12345.6,
            "at_least": method == "hold",
            "devices": n * snr,
            "devices_ci95": [n * snr, n * snr + 7],
        }
        for snr in (10.0, 20.0)
        for method, n in (("hjepa", 111), ("hold", 50))
    ]
    gain = {"method": "hjepa", "over": "hold", "snr_db": 20.0, "ratio": 2.22}
    document = {
        "law": "duty", "bandwidth_hz": 20e6, "slot_s": 1e-3, "limit_bits_per_s": 13.2,
        "acceptable_score": 0.62, "rows": rows, "gains": [gain | {"ratio_ci95": [2.0, None]}],
        "paper_gain_percent": 42.83, "checkpoint": None, "seed": 0, "n_devices": 256,
    }  # fmt: skip
    return finished("scale", document | changes)


def trained():
    gates = {
        "effective_rank": {"value": 3.0, "threshold": 4.0, "passed": False},
        "probe_r2_theta": {"value": 0.9, "threshold": 0.8, "passed": True},
        "probe_r2_x": {"value": 0.97, "threshold": 0.95, "passed": True},
        "actor_nrmse": {"value": 0.2, "threshold": 0.35, "passed": True},
    }
    rows = [
        {"step": step, "loss_prediction": 1 / step, "probe_r2_x": 0.5, "probe_r2_theta": None}
        for step in (1, 2, 3)
    ]
    document = {"checkpoint": "c", "seconds": 3.0, "gates": gates}
    return finished("train-encoder", document, rows)


@pytest.fixture
def without_figures(monkeypatch):
    """They take most of the time."""
    monkeypatch.setattr(report, "draw", lambda *run: {})


@pytest.fixture
def shell(tmp_path, monkeypatch, capsys):
    return open_shell(tmp_path, monkeypatch, capsys)


def test_a_report_is_self_contained_and_well_formed(shell):
    scaled(), evaluated(), trained()
    document = shell("report", "--json").document
    assert document["report"] == "report.html"
    assert document["runs"] == ["runs/train-encoder/0001", "runs/eval/0001", "runs/scale/0001"]
    text = Path("report.html").read_text()
    page = Reader(text)
    assert "script" not in page.tags and "link" not in page.tags and "iframe" not in page.tags
    pictures = [link for link in page.links if link.startswith("data:image/svg+xml;base64,")]
    assert pictures == page.links and len(pictures) == 1 + 3 + 1
    for picture in pictures:
        ElementTree.fromstring(base64.b64decode(picture.partition(",")[2]))
    assert not re.search(r"https?://", text)


def test_a_report_shows_numbers_intervals_settings_and_commands(shell, without_figures):
    scaled(), evaluated(), trained()
    shell("report")
    said = " ".join(Reader(Path("report.html").read_text()).texts)
    for text in (
        *("1110 (1110 – 1117)", "≥ 500 (500 – 507)", "12,346"),
        "hjepa hold 20 +122.0 % +100.0 % to unbounded",
        "hjepa eval --config runs/eval/0001/config.toml",
        *("effective_rank 3 ≥ 4 FAILED", "actor_nrmse 0.2 ≤ 0.35 passed"),
        *("0.950 (0.850 – 1.050)", "81.2 (75.0 – 90.5)", "≤ 0.0125 (0.0100 – 0.0200)"),
        *("256 devices", "effective_rank", "FAILED", "[protocol]", "version of torch"),
        "hjepa scale --config runs/scale/0001/config.toml",
    ):
        assert text in said, text


def test_rows_are_in_the_order_of_the_settings_and_the_states(shell, without_figures):
    """Not in that of the alphabet, in which results are stored."""
    methods = {name: entry(0.9) for name in ("oracle", "hold", "hjepa")}
    finished("eval", {"plant": "desktop", "seed": 0, "checkpoint": "m", "methods": methods})
    trained()
    shell("report")
    first = [row[0] for row in rows_of(Path("report.html").read_text())]
    methods_at = [first.index(name) for name in ("hjepa", "hold", "oracle")]
    assert methods_at == sorted(methods_at)
    gates_at = [first.index(name) for name in ("probe_r2_x", "probe_r2_theta", "effective_rank")]
    assert gates_at == sorted(gates_at)


def test_strides_are_told_from_the_highest_level_on(shell, without_figures):
    strides = {"l": 1, "m": 2, "h": 8}
    finished("train-hierarchy", {"checkpoint": "c", "seconds": 1, "strides": strides,
             "nmae_windows": {}})  # fmt: skip
    shell("report")
    assert "strides 8/2/1" in Path("report.html").read_text()


def test_the_commands_name_what_the_run_was_given(shell, without_figures):
    given = {
        name: {"path": str(Path(path).absolute()), "sha256": "0"}
        for name, path in (("dataset", "data/d"), ("encoder", "e/model.safetensors"))
    }
    settings = load_settings().as_dict()
    with Run.create("train-hierarchy", None, settings, given | {"remeasure": False}) as record:
        record.finish({"checkpoint": "c", "seconds": 1, "strides": dict.fromkeys("hml", 1),
                       "nmae_windows": {}})  # fmt: skip
    shell("report")
    command = "config.toml --dataset data/d --encoder e/model.safetensors"
    assert command in Path("report.html").read_text()


def test_further_models_have_no_flag(shell):
    """Each method's model is looked for again: `hjepa eval` takes one --checkpoint."""
    given = {name: {"path": f"/{name}"} for name in ("checkpoint", "checkpoint 2", "checkpoint 3")}
    assert runs.inputs_of({"inputs": given}) == ["--checkpoint", "/checkpoint"]


def test_a_smoke_run_is_called_one(shell, without_figures):
    trained()
    shell("report")
    assert "mean nothing" not in Path("report.html").read_text()
    with Run.create("train-encoder", None, load_settings("smoke").as_dict()) as record:
        record.finish({"checkpoint": "c", "seconds": 1.0, "gates": {}})
    shell("report")
    assert "mean nothing" in Path("report.html").read_text()


def rows_of(text):
    """The texts of every table's rows."""
    found = re.findall(r"<tr>(.*?)</tr>", text)
    return [[*map(re.compile(r"<[^>]*>").sub, [""] * 99, re.findall(r"<t[dh].*?</t[dh]>", row))]
            for row in found]  # fmt: skip


def test_names_cannot_smuggle_markup_in(shell, without_figures):
    evaluated(name="a&b<i>")
    assert shell("report", "runs/eval/a&b<i>").code == 0
    text = Path("report.html").read_text()
    page = Reader(text)
    assert "script" not in page.tags and "i" not in page.tags
    assert EVIL in "".join(page.texts) and "runs/eval/a&b<i>" in "".join(page.texts)


def test_every_stage_escapes_what_it_shows(shell, without_figures):
    windows = {EVIL: 0.1}
    finished("train-encoder", {"checkpoint": EVIL, "seconds": 1.0, "gates": {
        EVIL: {"value": 1.0, "threshold": 1.0, "passed": True}}})  # fmt: skip
    finished("train-hierarchy", {"checkpoint": EVIL, "seconds": 1.0, "method": EVIL,
             "strides": dict.fromkeys("hml", EVIL), "nmae_windows": windows})  # fmt: skip
    finished("train-reflex", {"checkpoint": EVIL, "seconds": 1.0, "n_rollouts": 1,
             "reflex": {"law": {}}, "nmae_windows": {EVIL: windows}})  # fmt: skip
    others = {"checkpoints": {"a": EVIL, "b": "mine", EVIL: "c"}, "checkpoint": "mine"}
    finished("eval", {"plant": EVIL, "seed": 0, "methods": {EVIL: entry(0.9)}, **others})
    shell("report")
    text = Path("report.html").read_text()
    assert "<script" not in text and "".join(Reader(text).texts).count(EVIL) == 17
    assert f"Of other models: {EVIL}: c; a: {EVIL}." in "".join(Reader(text).texts)


def test_equal_runs_give_equal_reports(shell):
    scaled()
    shell("report", "--out", "a.html")
    shell("report", "--out", "b.html")
    assert Path("a.html").read_bytes() == Path("b.html").read_bytes()


def test_figures_are_written_in_the_formats_asked_for(shell):
    finished("train-hierarchy", {"checkpoint": "c", "seconds": 1,
             "strides": dict.fromkeys("hml", 1), "nmae_windows": {}},
             [{"level": "high", "step": step, "loss": 0.5} for step in (1, 2)])  # fmt: skip
    arguments = ["report", "runs/train-hierarchy/0001", "--figures", "f", "--format", "pdf,png"]
    document = shell(*arguments, "--json").document
    names = {f"f/train-hierarchy-training.{kind}" for kind in ("pdf", "png")}
    assert set(document["figures"]) == names
    for name in names:
        data = Path(name).read_bytes()
        assert data.startswith(b"%PDF" if name.endswith("pdf") else b"\x89PNG")
        assert b"/Type3" not in data
    assert_one_line_error(shell("report", "--format", "bmp"), 2, "bmp", "svg")


def test_a_directory_of_runs_is_all_of_its_runs(shell, without_figures):
    scaled(), evaluated()
    assert len(shell("report", "runs", "--json").document["runs"]) == 2


def test_runs_of_another_version_say_what_to_do(shell, without_figures, monkeypatch):
    directory = evaluated()
    monkeypatch.setattr("hjepa_cli.stages.report.__version__", "9.9.9")
    shell("report")
    text = Path("report.html").read_text()
    assert "9.9.9" in text and f"hjepa eval --config {directory}/config.toml" in text


def test_what_is_no_run_is_refused(shell):
    with shell.untouched():
        assert_one_line_error(shell("report"), 66, "no finished run")
        assert_one_line_error(shell("report", "nowhere"), 66, "nowhere")
    with Run.create("eval", None, load_settings().as_dict()):
        pass
    assert_one_line_error(shell("report", "runs/eval/0001"), 66, "unfinished")
    finished("scale", {"law": "duty"})
    assert_one_line_error(shell("report", "runs/scale/0001"), 65, "result.json", "rows")


# --- the figures


def test_score_figure_draws_each_curve_with_its_band():
    figure = figures.score_figure(
        {"hjepa": entry(0.9), "hold": entry(0.6)}, "gap", acceptable_score=0.62, step_s=1e-3
    )
    (axes,) = figure.axes
    lines = {line.get_label(): line for line in axes.lines}
    assert axes.get_xscale() == "linear"
    np.testing.assert_allclose(lines["hjepa"].get_xdata(), [1, 2, 8])
    np.testing.assert_allclose(lines["hold"].get_ydata(), [0.6, 0.3, 0.075])
    corners = axes.collections[0].get_paths()[0].vertices
    assert corners[:, 1].max() == pytest.approx(0.99) and (8.0, 0.10125) in [
        (x, pytest.approx(y)) for x, y in corners
    ]
    other = figures.score_figure({"hjepa": entry(0.9)}, "delivery", acceptable_score=0.62,
                                 step_s=1e-3)  # fmt: skip
    assert other.axes[0].xaxis_inverted()


def test_error_figure_leaves_out_who_makes_no_error():
    exact = entry(1.0) | {"nmae": [1e-8] * 3, "nmae_ci95": [[0, 1e-8]] * 3}
    figure = figures.error_figure({"hjepa": entry(0.9), "oracle": exact}, step_s=20e-3)
    (axes,) = figure.axes
    ((line, _, (interval,)),) = axes.containers
    assert axes.containers[0].get_label() == "hjepa" and list(line.get_ydata()) == [0.025]
    assert interval.get_segments()[0][:, 1] == pytest.approx([0.02, 0.03])
    assert [label.get_text() for label in axes.get_xticklabels()] == ["20–400"]
    assert [legend.get_title().get_text() for legend in figure.legends] == ["no error: oracle"]


def test_windows_that_the_horizon_does_not_reach_are_left_out():
    short = entry(0.9)
    short["nmae_windows"] |= {"21-40": None}
    short["nmae_windows_ci95"] |= {"21-40": None}
    figure = figures.error_figure({"hjepa": short}, step_s=1e-3)
    assert [label.get_text() for label in figure.axes[0].get_xticklabels()] == ["1–20"]
    none = short | {"nmae_windows": {"1-20": None}}
    assert not figures.has_curves(figures.error_figure({"hjepa": none}, step_s=1e-3))


def test_a_report_of_those_who_make_no_error_has_no_empty_figure(shell):
    """Nor a warning about a legend without names: warnings are errors here."""
    exact = entry(1.0) | {"nmae": [1e-8] * 3, "nmae_ci95": [[0, 1e-8]] * 3}
    unlinked = exact | {"tolerance_gap_steps": None}
    for name, methods, count in (("o", {"oracle": exact}, 2), ("p", {"optimal": unlinked}, 0)):
        finished("eval", {"plant": "desktop", "seed": 0, "checkpoint": None, "methods": methods},
                 name=name)  # fmt: skip
        outcome = shell("report", f"runs/eval/{name}")
        assert (outcome.code, "Warning" in outcome.err) == (0, False)
        assert Path("report.html").read_text().count("<img") == count


def test_training_figure_has_a_line_per_loss_level_and_health_measure():
    rows = [{"step": "1", "loss_a": "0.5", "loss_b": "2", "probe_r2_x": "0.9", "std": "1"}]
    figure = figures.training_figure(rows)
    assert [[line.get_label() for line in axes.lines] for axes in figure.axes] == [
        ["a", "b"],
        ["x"],
    ]
    levels = [{"level": name, "step": "5", "loss": "1"} for name in ("high", "low")]
    (axes,) = figures.training_figure(levels).axes
    assert [line.get_label() for line in axes.lines] == ["high", "low"]


def test_rounds_of_a_level_are_one_line_after_the_other():
    rounds = [{"step": str(step), "level": f"fusion round {number}", "loss": f"{1 / number}"}
              for number in (1, 2, 3) for step in (50, 100)]  # fmt: skip
    (axes,) = figures.training_figure(rounds).axes
    (line,) = axes.lines
    assert line.get_label() == "fusion"
    assert line.get_xdata().tolist() == [50, 100, 150, 200, 250, 300]


def test_a_run_of_reflexes_has_its_section(shell, without_figures):
    windows = {"1-20": 0.0571, "21-40": 0.04}
    document = {
        "checkpoint": "r/model.safetensors",
        "seconds": 200.0,
        "n_rollouts": 40,
        "reflex": {
            "gain": 2.61,
            "tau_steps": 6.88,
            "law": {"gain": 1.31, "tau_steps": 9.21, "gains_n": [[-21.5, -6.2, -48.2, -3.8]]},
        },
        "nmae_windows": dict.fromkeys(("hold-decay", "hold-decay-linear", "chunk"), windows),
    }
    made = finished("train-reflex", document)
    assert shell("report", made, "--json").code == 0
    text = (shell.directory / "report.html").read_text()
    for part in ("Reflexes, r/model.safetensors", "0.0571", "2.61", "9.21", "chunk"):
        assert part in text, part


def test_a_run_of_fusion_has_its_section(shell, without_figures):
    distances = {"predicted": 0.02, "packets": 0.11, "corrected": 0.00731}
    document = {"checkpoint": "f/model.safetensors", "seconds": 90.0, "packets": 4321}
    made = finished("train-fusion", document | {"distances": distances})
    assert shell("report", made, "--json").code == 0
    text = (shell.directory / "report.html").read_text()
    for part in ("Posterior, f/model.safetensors", "4321 packets", "0.11000", "0.00731"):
        assert part in text, part


WIRE = {
    "model": "exported",
    "method": "hjepa",
    "plant": "desktop",
    "seed": 3,
    "devices": 2,
    "steps": 20,
    "lockstep": False,
    "period_ms": 7.5,
    "n_devices": 2,
    "n_steps": 20,
    "score_link": 0.81,
    "score_link_ci95": [0.8, 0.82],
    "score_simulated": 0.82,
    "score_simulated_ci95": [0.81, 0.83],
    "score_difference": -0.01234,
    "score_difference_ci95": [-0.02, 0.01],
    "missing_share": 0.0,
    "late_answers_share": 0.5,
    "ages": {"0": 3, "2": 3},
    "sources": {"planned": 40, "held": 0},
    "skipped_strides": 77,
    "theta_difference_rad": {"20": 1e-6},
}


def test_a_run_over_the_wire_has_its_section(shell):
    assert shell("report", finished("bench-link", WIRE), "--json").code == 0
    text = (shell.directory / "report.html").read_text()
    for part in ("7.5 ms a step", "-0.0123", "77", "in 20 steps"):
        assert part in text, part
    assert text.count("<img") == 1


@pytest.mark.parametrize(
    "change", [{"ages": {"0": "many"}}, {"score_link": None}, {"period_ms": "slow"}]
)
def test_a_damaged_run_over_the_wire_is_refused(shell, change):
    made = finished(
        "bench-link",
        WIRE | change,
        inputs={"model": {"path": "exported", "sha256": "0"}, "gap_steps": 80},
    )
    assert_one_line_error(shell("report", made), 65, "lacks what a bench-link run has")


def test_runs_that_no_report_shows_are_refused(shell):
    made = finished("collect", {"dataset": "d"})
    assert_one_line_error(shell("report", made), 66, "no run of train-encoder")


# --- the page


def test_counts_stand_below_their_snr_in_whatever_order_it_was_asked_for(shell, without_figures):
    row = {"method": "hold", "bits_per_s": None, "at_least": False}
    counts = {30.0: 2481, 10.0: 861, 20.0: 1657}  # as of --snr 30,10,20
    rows = [
        row | {"snr_db": snr_db, "devices": n, "devices_ci95": [n, n]}
        for snr_db, n in counts.items()
    ]
    shell("report", scaled(rows=rows, gains=[]))
    texts = "|".join(filter(str.strip, Reader(Path("report.html").read_text()).texts))
    assert "|10 dB|20 dB|30 dB|" in texts
    assert "|hold|861 (861 – 861)|1657 (1657 – 1657)|2481 (2481 – 2481)" in texts


def test_a_report_names_the_layer_and_the_link_that_counts_are_for(shell, without_figures):
    late = {"delay_steps": 30, "jitter_steps": 10, "downlink_loss": 0.2, "confirmation_bits": 48}
    cell = "duty law, packets 30 to 40 steps late, 20 % of the forces lost, a 5G NR uplink, 20 MHz"
    shell("report", scaled(phy="nr", link=late))
    texts = [" ".join(one.split()) for one in Reader(Path("report.html").read_text()).texts]
    headline = f"One cell ({cell}, 1 ms slots) supports 2220 (2220 – 2227) devices with hjepa at 20"
    assert any(one.startswith(headline) for one in texts)
    assert any(one.startswith(f"Devices per cell: {cell}") for one in texts)
    shell("report", evaluated(link=late))
    page_text = " ".join(Path("report.html").read_text().split())
    assert "packets 30 to 40 steps late, 20 % of the forces lost. Score and LQ ratio" in page_text


def test_the_result_comes_first_and_stages_in_their_order(shell, without_figures):
    scaled(), evaluated(), trained()
    shell("report")
    text = Path("report.html").read_text()
    told = text.index('class="headline"')
    assert "supports 2220 (2220 – 2227) devices with hjepa at 20 dB; 1000 with hold." in text
    places = [text.index(f"<h2>{stage}: ") for stage in ("train-encoder", "eval", "scale")]
    assert [told, *places] == sorted([told, *places])
    shell("report", "runs/eval")
    text = Path("report.html").read_text()
    assert "hjepa tolerates gaps of 81.2 (75.0 – 90.5) steps between packets" in text
    shell("report", "runs/train-encoder")
    assert 'class="headline"' not in Path("report.html").read_text()


def test_methods_are_explained(shell, without_figures):
    evaluated()
    shell("report")
    said = " ".join(" ".join(row) for row in rows_of(Path("report.html").read_text()))
    assert "hjepa predicts the embedding in three strides" in said


def test_every_method_of_the_package_is_explained():
    unexplained = [name for name in METHODS if not page.explained(name)]
    assert not unexplained
    assert not any("plugin" in page.explained(name) for name in METHODS)
    assert page.explained("ts-jepa-12").endswith("12 steps at a time")
    assert page.explained("supervised-2+6") == page.explained("supervised-2")


def test_wide_tables_are_split_and_repeat_their_first_column():
    """20 columns in three parts of at most 9; whatever is empty is left out."""
    columns = ["method", *map(str, range(20))]
    row = ["hjepa", *range(20)]
    found = page.parts(columns, [row, ["none", *[None] * 20], ["half", *range(10), *[None] * 10]])
    assert [len(part.columns) for part in found] == [8, 8, 7]
    for part in found:
        assert part.columns[0] == ("method", True)
        assert part.rows[0][0] == ("hjepa", True)
        assert "none" not in [cells[0][0] for cells in part.rows]
    numbers = [name for part in found for name, _ in part.columns[1:]]
    assert numbers == columns[1:]
    assert [len(part.rows) for part in found] == [2, 2, 1]
    assert page.parts(columns, []) == []


def test_nothing_of_a_page_is_cut_on_paper_and_no_row_is_empty(shell):
    """Tables have at most nine columns and may wrap in print; figures are as wide as the page."""
    rows = [f"{snr}" for snr in range(10, 31)]
    assert len(rows) > page.MOST_COLUMNS
    scaled(), evaluated(), trained()
    shell("report")
    text = Path("report.html").read_text()
    for table in re.findall(r"<table>.*?</table>", text, re.DOTALL):
        for row in re.findall(r"<tr>(.*?)</tr>", table, re.DOTALL):
            cells = re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row)
            assert 1 < len(cells) <= page.MOST_COLUMNS + 1
        for row in re.findall(r"<tr>(<td.*?)</tr>", table, re.DOTALL):
            assert any(re.findall(r"<td[^>]*>(.*?)</td>", row)[1:]), row
    style = text[text.index("<style>") : text.index("</style>")]
    printed = style[style.index("@media print") :]
    assert "landscape" in style and "overflow: visible" in printed
    assert "white-space: normal" in printed
    assert "figure img { width: 100%;" in style and "27rem" not in style
    for picture in re.findall(r"svg\+xml;base64,([^\"]*)", text):
        svg = ElementTree.fromstring(base64.b64decode(picture))
        assert float(svg.get("width").removesuffix("pt")) == pytest.approx(72 * PAGE_IN)


def test_files_are_as_wide_as_a_column_with_the_looks_that_were_asked_for(shell):
    scaled()
    asked = ("--title", "my cell", "--labels", "hjepa=H-JEPA, hold=last force", "--log")
    shell("report", "--figures", "f", "--format", "svg", *asked)
    svg = ElementTree.parse("f/scale-devices.svg").getroot()
    assert float(svg.get("width").removesuffix("pt")) == pytest.approx(72 * COLUMN_IN)
    text = Path("f/scale-devices.svg").read_text()
    for said in ("my cell", "H-JEPA", "last force (at least)"):
        assert f"<!-- {said} -->" in text, said
    with shell.untouched():
        wrong = shell("report", "--labels", "hjeap=x")
        assert_one_line_error(wrong, 2, "no method or scheduler 'hjeap'", "hjepa")
        assert_one_line_error(shell("report", "--labels", "hjepa"), 2, "NAME=TEXT")


def test_a_film_is_shown_and_its_absence_told(shell, without_figures):
    scaled()
    shell("report")
    assert "hjepa view --out film.gif" in Path("report.html").read_text()
    film = b"GIF89a" + bytes(20)
    Path("film.gif").write_bytes(film)
    shell("report", "--film", "film.gif")
    text = Path("report.html").read_text()
    assert f"data:image/gif;base64,{base64.b64encode(film).decode()}" in text
    assert "No film" not in text
    with shell.untouched():
        missing = shell("report", "--film", "other.gif")
        assert_one_line_error(missing, 66, "other.gif", "hjepa view --out other.gif")
        assert_one_line_error(shell("report", "--film", "report.html"), 2, "not a GIF", "view")


def test_what_a_figure_lacks_is_told_with_the_command_that_makes_it(shell):
    """Neither an empty figure nor a figure of half the methods."""
    older = entry(0.5)
    del older["nmae_windows_ci95"]
    methods = {"hjepa": entry(0.95), "hold": older}
    finished("eval", {"plant": "desktop", "seed": 0, "checkpoint": "m", "methods": methods})
    finished("train-encoder", {"checkpoint": "c", "seconds": 3.0, "gates": {}})
    outcome = shell("report")
    assert outcome.code == 0 and not Path("runs/train-encoder/0001/metrics.csv").exists()
    text = Path("report.html").read_text()
    assert text.count("<img") == 2  # scores against gap and delivery
    for command in (
        "hjepa eval --config runs/eval/0001/config.toml --remeasure",
        "hjepa train-encoder --config runs/train-encoder/0001/config.toml",
    ):
        assert command in outcome.err and f"again: {command}</p>" in text, command


def test_a_wrong_label_is_refused_before_anything_is_planned(shell):
    with shell.untouched():
        for command in ("scale", "eval --figure", "compare --figures f"):
            words = [*command.split(), "--labels", "hjeap=x"]
            assert_one_line_error(shell(*words), 2, "no method or scheduler 'hjeap'")
        assert_one_line_error(shell("scale", "--labels", "a=b", "--dry-run"), 2, "'a'")
        assert_one_line_error(shell("eval", "--title", "x"), 2, "none is drawn", "--figure")


def test_a_dollar_is_a_dollar():
    assert looks.Looks.of(title="$1 and $2").titled("") == r"\$1 and \$2"
    assert looks.Looks.of(labels=["hold=$"]).named("hold") == r"\$"


def test_scale_draws_what_is_asked_for_and_a_finished_run_again(shell):
    words = ("scale", "--tolerance-steps", "80", "--snr", "10:30", "--out", "s")
    first = shell(*words, "--json").document
    assert {Path(path).suffix for path in first["figures"]} == {".png", ".svg", ".pdf"}
    assert "<!-- again -->" not in Path("s/devices.svg").read_text()
    again = shell(*words, "--title", "again", "--json").document
    assert "<!-- again -->" in Path("s/devices.svg").read_text()
    assert again["rows"] == first["rows"] and again["figures"] == first["figures"]
