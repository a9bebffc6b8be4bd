"""The stage ``scale``, on hand-made curves and on real ones of the true-state methods."""

import csv
import io
import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_device_counts import entry

from hjepa_cli.config.checks import split_late
from hjepa_cli.config.schema import LONGEST_GAP_STEPS
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.plants.named import plant
from hjepa_cli.errors import MissingInputError, NumericalError, UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import report, scale, scale_by_formula

ENTRIES = {
    "hjepa": entry(gap=112.0, p=0.02),
    "ts-jepa-1": entry(gap=100.0, p=0.022),
    "hold": entry(gap=43.0, p=0.037),
    "zero": entry(gap=0.0, p=1.0, spread=0.0),
    "optimal": entry(gap=None, p=None, bits=None),
    "oracle": entry(gap=320.0, p=0.01, censored=True),
}


@pytest.fixture
def stage(tmp_path, monkeypatch):
    """``scale`` in an empty directory on :data:`ENTRIES`; returns a function of its flags."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    calls = []

    def open_measurable(settings, screen, checkpoint, dataset, further=None):
        if checkpoint == "missing":
            raise MissingInputError("no model 'missing'")
        skipped = {name: "train it" for name in settings.methods if name not in ENTRIES}
        return SimpleNamespace(
            settings=settings,
            asked=(checkpoint, dataset),
            skipped=lambda methods: skipped,
            measurable=lambda methods: [name for name in methods if name in ENTRIES],
            of=lambda method: SimpleNamespace(settings=settings, model=None),
            inputs=lambda **flags: flags,
        )

    def curves_for(subject, screen, record, **arguments):
        calls.append((*subject.asked, arguments))
        found = {name: ENTRIES[split_late(name)[0]] for name in arguments["methods"]}
        model = {"checkpoint": "model", "checkpoints": {}}
        return model | {"methods": found, "source": "curves of the test"}

    def build_driver(name, settings, model):
        return SimpleNamespace(bits_per_transmission=ENTRIES[name]["bits_per_transmission"])

    monkeypatch.setattr(scale_by_formula, "build_driver", build_driver)
    monkeypatch.setattr(scale_by_formula, "open_measurable", open_measurable)
    monkeypatch.setattr(scale_by_formula, "curves_for", curves_for)

    def call(
        snr="10:30", methods=tuple(ENTRIES), law="duty", config=None, quiet=False, **arguments
    ):
        flags = {"radio.snr_db": snr, "radio.law": law, "methods": methods} | (config or {})
        call.out, call.err = io.StringIO(), io.StringIO()
        screen = Screen(quiet, stdout=call.out, stderr=call.err)
        with monkeypatch.context() as patch:
            if not call.figures:  # half a second each
                patch.setattr(scale, "draw", lambda *ignored: [])
            return scale.run(load_settings(flags=flags), screen, **arguments)

    call.figures = False
    call.curves = calls
    return call


def by_method(result, snr_db=20.0):
    return {row["method"]: row for row in result["rows"] if row["snr_db"] == snr_db}


def test_document(stage):
    result = stage()
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    assert result["law"] == "duty"
    assert result["bandwidth_hz"] == 20e6 and result["slot_s"] == 1e-3
    assert result["limit_bits_per_s"] == pytest.approx(13.229262922)
    assert len(result["rows"]) == 5 * len(ENTRIES)
    assert [row["snr_db"] for row in result["rows"][:: len(ENTRIES)]] == [10, 15, 20, 25, 30]
    for row in result["rows"]:
        assert {"snr_db", "method", "devices", "devices_ci95", "bits_per_s"} <= row.keys()
    rows = by_method(result)
    assert rows["hjepa"]["devices"] == 7225 and rows["zero"]["devices"] == 0
    assert rows["optimal"]["devices"] is None and rows["oracle"]["at_least"]
    assert rows["zero"]["reason"] and not rows["hjepa"]["reason"]


def test_raw_frames_are_as_late_as_they_take_slots(stage, monkeypatch):
    bits = 2 * 64 * 128 * 3 * 8
    monkeypatch.setitem(ENTRIES, "supervised-2", entry(gap=30.0, p=0.1, bits=bits))
    monkeypatch.setitem(ENTRIES, "local", entry(gap=320.0, p=1 / 320, bits=0, censored=True))
    result = stage(methods=("supervised-2", "local"), verify=False)
    assert stage.curves[0][2]["methods"] == [
        *("supervised-2+6", "local", "supervised-2+4", "supervised-2+3", "supervised-2+2")
    ]
    for row in result["rows"]:
        if row["method"] == "local":
            assert row["devices"] is None and "sends nothing" in row["reason"]
            continue
        slots = bits / (20e6 * 1e-3 * math.log2(1 + 10 ** (row["snr_db"] / 10)))
        assert row["delay_steps"] == math.ceil(slots)
        assert row["devices"] == math.floor(30.0 / slots)
    assert "supervised-2, 6 steps late" in stage.out.getvalue()
    stage(methods=("supervised-2",), law="equal")
    assert stage.curves[1][2]["methods"] == ["supervised-2"]
    wide = {"radio.bandwidth_hz": 1e9}  # a slot carries a whole packet
    assert stage(methods=("supervised-2",), config=wide)["rows"][0]["delay_steps"] == 0


@pytest.mark.parametrize("start", ["steady", "paper"])
def test_a_stated_gap_is_charged_as_the_protocol_starts(tmp_path, monkeypatch, start):
    """⌊D c⌋ of 320 steps; K steps from the start on have 1 − 1/D packets more."""
    monkeypatch.chdir(tmp_path)
    settings = load_settings(flags={"radio.snr_db": "20", "protocol": start})
    quiet = Screen(True, stdout=io.StringIO(), stderr=io.StringIO())
    monkeypatch.setattr(scale, "draw", lambda *ignored: [])
    [row] = scale.run(settings, quiet, tolerance_steps=320, checkpoint="desktop-h4m2l1")["rows"]
    c, steps = 20e6 * 1e-3 * math.log2(101) / 2064, settings.protocol.steps
    extra = 0 if start == "steady" else 1 - 1 / 320
    assert row["devices"] == math.floor(c * steps / (steps / 320 + extra))


def test_a_stated_gap_has_no_interval_and_no_score(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(scale, "draw", lambda *ignored: [])  # half a second each
    monkeypatch.setattr(report, "draw", lambda *ignored: {})
    screen = Screen(stdout=(out := io.StringIO()), stderr=io.StringIO())
    settings = load_settings(flags={"radio.snr_db": "20"})
    given = {"tolerance_steps": 2.5, "checkpoint": "desktop-h4m2l1"}
    [row] = scale.run(settings, screen, **given, out=Path("s"))["rows"]
    count = math.floor(2.5 * 20e6 * 1e-3 * math.log2(101) / 2064)
    assert row["devices"] == count and row["devices_ci95"] is row["tolerance_ci95"] is None
    printed = out.getvalue()
    assert "a packet every 2.5 steps, as stated" in " ".join(printed.split())
    assert f" {count}\n" in printed and "95 %" not in printed and "score" not in printed
    with open("s/devices.csv", newline="") as file:
        assert [line["devices_ci95_low"] for line in csv.DictReader(file)] == [""]
    report.run(screen, [Path("s")], out=Path("r.html"))
    assert "95 %" not in Path("r.html").read_text().partition("<h3>")[0]


@pytest.mark.parametrize("steps", [0.5, 1e9, math.inf, math.nan])
def test_a_gap_that_counts_cannot_take_is_refused(steps):
    for run in (scale.run, scale.plan):
        screen = {"screen": Screen(True)} if run is scale.run else {}
        with pytest.raises(UsageError, match=r"expected 1 to 1e\+08"):
            run(load_settings(), **screen, tolerance_steps=steps)


def test_the_widest_band_and_the_longest_gap_stay_in_range():
    widest = load_settings(flags={"radio.bandwidth_hz": 1e11, "radio.snr_db": "100"})
    c = 1e11 * plant("gym").step_s * math.log2(1 + 1e10)  # of packets of a bit
    assert LONGEST_GAP_STEPS * c < np.iinfo(np.int64).max and widest.radio.bandwidth_hz == 1e11


@pytest.mark.parametrize(
    ("named", "given"),
    [
        ("--verify", {"verify": True}),
        ("--remeasure", {"remeasure": True}),
        ("--dataset", {"dataset": Path("data")}),
        ("further", {"further": [Path("model")]}),
        ("--methods", {}),
    ],
)
def test_what_measures_is_refused_beside_a_stated_gap(named, given):
    settings = load_settings(flags={"methods": ("hold",)} if named == "--methods" else {})
    for function, more in ((scale.run, {"screen": Screen(True)}), (scale.plan, {})):
        with pytest.raises(UsageError, match=f"{named} is of what is measured"):
            function(settings, **more, **given, tolerance_steps=8)


def test_gains_stand_beside_the_papers(stage):
    result = stage()
    assert [(gain["over"], gain["snr_db"]) for gain in result["gains"]] == [
        ("ts-jepa-1", 20.0),
        ("hold", 20.0),
    ]  # the oracle's count is a bound, and a ratio to it none at all
    assert result["gains"][0]["ratio"] == pytest.approx(1.12, abs=1e-3)
    printed = stage.out.getvalue()
    assert "hjepa over ts-jepa-1 at 20 dB: +12.0 % devices (95 % CI " in printed
    assert printed.count("the paper: up to +42.83 %") == 1  # it has no other ratio
    assert stage(snr="10:15")["gains"][0]["snr_db"] == 15.0  # the highest, where 20 dB is not asked
    assert stage(methods=("hold", "zero"))["gains"] == []


def test_the_best_flat_predictor_is_a_rival(stage, monkeypatch):
    monkeypatch.setitem(ENTRIES, "ts-jepa-4", entry(gap=120.0, p=0.02))
    found = {gain["over"]: gain["ratio"] for gain in stage(methods=tuple(ENTRIES))["gains"]}
    assert list(found) == ["ts-jepa-1", "ts-jepa-4", "hold"]
    assert found["ts-jepa-4"] == pytest.approx(112 / 120, abs=1e-3)


def test_the_laws_differ(stage):
    duty, equal = by_method(stage()), by_method(stage(law="equal"))
    assert duty["hjepa"]["devices"] / duty["hold"]["devices"] == pytest.approx(112 / 43, rel=1e-3)
    assert equal["hjepa"]["devices"] / equal["hold"]["devices"] < 1.1
    scaled = by_method(stage(law="equal", config={"radio.noise": "scaled"}))
    assert scaled["hjepa"]["devices"] > equal["hjepa"]["devices"]


def test_tables_show_every_method_and_snr_in_80_columns(stage):
    for law in ("duty", "equal"):
        stage(law=law)
        printed = stage.out.getvalue()
        tables = [line for line in printed.splitlines() if "paper" not in line]
        assert max(map(len, tables)) <= 80
        for text in (*ENTRIES, "10 dB", "15 dB", "20 dB", "25 dB", "30 dB", "÷limit"):
            assert text in printed, text
    stage()
    assert "112.0 (100.8 – 123.2)" in stage.out.getvalue()
    assert "7225 (6503 – 7948)" in stage.out.getvalue()
    assert "≥ 320.0 (288.0 – 352.0)" in stage.out.getvalue()
    stage(law="equal")
    assert "≤ 0.0100 (0.0090 – 0.0110)" in stage.out.getvalue()


def test_csv_is_the_table_in_long_format(stage):
    result = stage()
    with open(result["csv"], newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == len(result["rows"])
    for line, row in zip(lines, result["rows"], strict=True):
        assert line["method"] == row["method"] and float(line["snr_db"]) == row["snr_db"]
        assert line["devices"] == ("" if row["devices"] is None else str(row["devices"]))
        assert (line["bits_per_s"] != "") == (row["bits_per_s"] is not None)
    assert {"snr_db", "bits_per_s", "devices_ci95_low"} <= lines[0].keys()


def test_results_do_not_depend_on_the_run(stage, tmp_path):
    """Equal curves give equal files, byte for byte."""
    stage.figures = True
    first, second = stage(), stage()
    assert first["csv"] != second["csv"]
    assert len(first["figures"]) == 3
    for a, b in zip(
        [first["csv"], *first["figures"]], [second["csv"], *second["figures"]], strict=True
    ):
        assert (tmp_path / a).read_bytes() == (tmp_path / b).read_bytes()


def test_the_run_directory_holds_everything(stage, tmp_path):
    stage.figures = True
    stage(out=tmp_path / "here")
    names = {path.name for path in (tmp_path / "here").iterdir()}
    assert {"devices.csv", "devices.png", "devices.svg", "config.toml", "result.json"} <= names


def test_a_finished_run_is_shown_again_without_measuring(stage, tmp_path):
    first = stage(out=tmp_path / "here")
    printed = stage.out.getvalue()
    calls = len(stage.curves)
    assert stage(out=tmp_path / "here") == first
    assert stage.out.getvalue() == printed
    for flag in ("remeasure", "verify"):
        with pytest.raises(UsageError, match=f"finished without --{flag}"):
            stage(out=tmp_path / "here", **{flag: True})
    assert len(stage.curves) == calls
    with pytest.raises(UsageError, match=r"a finished run with other settings: radio\.snr_db = "):
        stage(out=tmp_path / "here", snr="10:20")


def test_flags_reach_the_curves(stage, tmp_path):
    stage(remeasure=True, dataset=tmp_path / "data", checkpoint="zoo-name")
    [(name, data, arguments)] = stage.curves
    assert (name, data) == ("zoo-name", tmp_path / "data")
    assert arguments["remeasure"] is True


def test_without_matplotlib_the_table_stays_and_the_pip_line_is_named(stage, monkeypatch):
    stage.figures = True
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.delitem(sys.modules, "hjepa_cli.output.figures", raising=False)
    monkeypatch.delattr("hjepa_cli.output.figures", raising=False)
    result = stage()
    assert result["figures"] == []
    assert 'pip install "hjepa[plot]"' in stage.err.getvalue()
    assert "7225" in stage.out.getvalue()


def test_quiet_prints_the_result_only(stage):
    stage(quiet=True)
    assert "7225" in stage.out.getvalue() and stage.err.getvalue() == ""


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ({"snr": "30:10"}, UsageError),
        ({"checkpoint": "missing"}, MissingInputError),
    ],
)
def test_refusals_write_nothing(stage, tmp_path, arguments, error):
    with pytest.raises(error):
        stage(out=tmp_path / "here", **arguments)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def blocks(stage, monkeypatch):
    """Replace the closed loop: a score that falls by 0.3 per tolerance, ±0.02."""
    asked = []

    def measure_points(subject, screen, points):
        measured = {name: [] for name in points}
        for method, point in ((name, one) for name, of in points.items() for one in of):
            kind = "gap_steps" if point.kind == "gap" else "p"
            [(key, value)] = point.coordinate().items()
            asked.append((method, value))
            share = value / ENTRIES[method][f"tolerance_{kind}"]
            wider = share if key == "d" else 1 / share
            score = 0.62 - blocks.slope * (wider - 1)
            ci95 = [score - 0.02, score + 0.02]
            measured[method].append(
                {key: value, "score": score, "ci95": ci95, "lq_ratio": 0.3, "n_devices": 256}
            )
        return measured

    monkeypatch.setattr(scale_by_formula, "measure_points", measure_points)
    blocks = SimpleNamespace(asked=asked, slope=0.3)
    return blocks


@pytest.mark.parametrize("law", ["duty", "equal"])
def test_verify_drives_both_sides_of_every_tolerance(stage, blocks, law):
    result = stage(law=law, verify=True, methods=("hjepa", "hold", "zero", "optimal", "oracle"))
    assert all(check["passed"] for check in result["verify"])
    asked = {name: [value for of, value in blocks.asked if of == name] for name, _ in blocks.asked}
    assert asked.keys() == {"hjepa", "hold", "oracle"}  # zero and optimal have no tolerance
    tolerance = 112.0 if law == "duty" else 0.02
    assert asked["hjepa"] == pytest.approx([0.9 * tolerance, 1.1 * tolerance])
    assert len(asked["oracle"]) == 1  # its tolerance is a bound: only the inside is known
    inside = {
        check["share_of_tolerance"] for check in result["verify"] if check["expected"] == "above"
    }
    assert inside == {0.9 if law == "duty" else 1.1}
    assert "verified" in stage.out.getvalue()


def test_verify_fails_where_the_loops_disagree(stage, blocks, tmp_path):
    blocks.slope = -0.3
    with pytest.raises(NumericalError, match=r"not verified: hjepa at 0\.9 x its tolerance"):
        stage(verify=True, methods=("hjepa",), out=tmp_path / "here")
    assert "NOT VERIFIED" in stage.out.getvalue()
    # What was counted is kept, and the verdict stays.
    assert (tmp_path / "here" / "result.json").exists()
    with pytest.raises(NumericalError, match="not verified"):
        stage(verify=True, methods=("hjepa",), out=tmp_path / "here")


def test_verify_fails_where_the_interval_decides_nothing(stage, blocks):
    blocks.slope = 0.1  # 0.63 ± 0.02 inside: neither above nor below
    with pytest.raises(NumericalError, match=r"not clearly above 0\.62"):
        stage(verify=True, methods=("hjepa",))


def test_verify_asks_for_no_more_than_a_packet_in_every_slot(stage, blocks, monkeypatch):
    monkeypatch.setitem(ENTRIES, "zero", entry(gap=1.05, p=0.95))
    stage(verify=True, methods=("zero",))
    stage(verify=True, methods=("zero",), law="equal")
    assert blocks.asked == [("zero", pytest.approx(1.155)), ("zero", pytest.approx(0.855))]


def test_real_curves_of_the_true_state_methods(tmp_path, monkeypatch):
    """Nothing replaced: measure, count, draw, and take the same curves again from the cache."""
    monkeypatch.chdir(tmp_path)
    settings = load_settings(
        "smoke",
        flags={
            "methods": ("hold-true", "optimal"),
            "control.gains_n": [],
            "radio.snr_db": "20:20",
            "protocol": "paper",
            "protocol.steps": 120,
            "protocol.gaps": (1, 40, 80),
        },
    )
    first, again = (
        scale.run(settings, Screen(stdout=io.StringIO(), stderr=io.StringIO())) for _ in range(2)
    )
    assert again["rows"] == first["rows"]
    assert not list(tmp_path.glob("runs/eval/*"))  # one command, one run directory
    curves = tmp_path / "runs/scale/0001/curves.json"
    assert str(curves.relative_to(tmp_path)) in again["source"]
    measured = json.loads(curves.read_text())["methods"]["hold-true"]
    tolerance = measured["tolerance_gap_steps"]
    assert 1 < tolerance <= 80
    hold = by_method(first)["hold-true"]
    bits = measured["bits_per_transmission"]
    assert bits == 2064
    c = 20_000 * math.log2(101) / bits
    sent = 1 / tolerance + (1 - 1 / tolerance) / 120  # a step: everybody is heard at the start
    assert hold["devices"] == math.floor(c / sent)
    assert hold["bits_per_s"] == pytest.approx(bits * sent / 1e-3)
    assert by_method(first)["optimal"]["devices"] is None
