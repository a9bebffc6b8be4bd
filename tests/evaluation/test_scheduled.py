"""``scale --law scheduled`` on the true-state methods."""

import csv
import io
import json
import math
import re
from pathlib import Path

import pytest
from command_line import assert_one_line_error, open_shell

from hjepa_cli.compute.executors import placed
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.drivers import build_driver
from hjepa_cli.core.control.loop import Draws, every_step, gap_schedule, simulate
from hjepa_cli.core.evaluation import load_search as core_scheduled
from hjepa_cli.core.evaluation import load_simulator
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.radio.coding import packet_uses
from hjepa_cli.core.radio.factory_hall import drop_devices
from hjepa_cli.core.radio.phy.shannon import report_bits
from hjepa_cli.errors import MissingInputError, NumericalError, UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import block_loads, report, scale
from hjepa_cli.stages.scale_by_simulation import BySimulation
from hjepa_cli.storage import zoo

SMALL = {
    "protocol": "paper",
    "protocol.steps": 150,
    "protocol.bracket": 0.2,
    "protocol.bootstrap": 200,
    "control.gains_n": [],
}


@pytest.fixture
def stage(tmp_path, monkeypatch):
    """The stage in an empty directory; returns a function of its settings."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(core_scheduled, "BLOCK_DEVICES", 100)
    monkeypatch.setattr(zoo, "zoo_directory", lambda: tmp_path / "none")  # whose law would count

    def call(*methods, verify=False, **flags):
        given = {"radio." + key: value for key, value in flags.items()}
        law = {"radio.law": "scheduled", "methods": list(methods)}
        call.out = io.StringIO()
        screen = Screen(True, stdout=call.out, stderr=io.StringIO())
        settings = load_settings(flags={**SMALL, **law, **given})
        return scale.run(settings, screen, verify=verify)

    return call


def test_round_robin_without_fading_agrees_with_duty(stage):
    result = stage("hold-true", schedulers=["round-robin"], power_margin_db=300.0, snr_db="20")
    (row,) = result["rows"]
    load = row["load_per_block"]
    # Under duty a gap of D = load has the acceptable score: the same loops, other turns.
    settings = load_settings(flags=SMALL)
    draws, method = Draws.make(settings.protocol, 150, 0), build_driver("hold-true", settings, None)
    gap = gap_schedule(load, draws.steps, 150)
    scores = [
        simulate(plant("desktop"), draws, schedule[None], method.controller(150), method.sensor)
        for schedule in (gap, every_step(draws.steps, 150))
    ]
    assert scores[0].score.mean() / scores[1].score.mean() == pytest.approx(0.62, abs=0.03)
    assert row["devices"] == math.floor(load * 20e3 * math.log2(101) / 2064)
    assert row["packets_per_block_slot"] == 1  # of the slots after the first, which none counts
    assert row["bits_per_s"] == pytest.approx(2064e3 / load)


def test_document_table_and_reports(stage):
    schedulers = ["round-robin", "innovation"]
    result = stage("hold-true", schedulers=schedulers, snr_db="10:20:10")
    assert json.loads(json.dumps(result, allow_nan=False, default=str))["law"] == "scheduled"
    assert [(row["snr_db"], row["scheduler"]) for row in result["rows"]] == [
        (10.0, "round-robin"),
        (10.0, "innovation"),
        (20.0, "round-robin"),
        (20.0, "innovation"),
    ]
    turns, ours = result["rows"][2:]
    assert turns["reports_per_block_slot"] == 0 and ours["reports_per_block_slot"] > 0.3
    assert result["rows"][0]["load_per_block"] == turns["load_per_block"]  # whatever the SNR
    # Reports are paid for: N (packet + reports) is what a slot carries times the load.
    bits = 2064 + ours["reports_per_block_slot"] * report_bits(ours["devices"])
    slot_bits = 20e3 * math.log2(101)
    assert ours["devices"] == math.floor(ours["load_per_block"] * slot_bits / bits)
    per_slot = ours["packets_per_block_slot"] * 2064 + bits - 2064
    assert ours["bits_per_s"] == pytest.approx(1000 * per_slot / ours["load_per_block"])
    assert ours["ratio_to_limit"] == pytest.approx(ours["bits_per_s"] / 13.229262922)
    low, high = ours["devices_ci95"]
    assert low <= ours["devices"] <= high
    (found,) = result["gains"]
    assert found["ratio"] == ours["devices"] / turns["devices"]
    printed = stage.out.getvalue()
    assert "hold-true, innovation" in printed and "over hold-true, round-robin at 20 dB" in printed
    with open(result["csv"]) as file:
        assert [int(row["devices"]) for row in csv.DictReader(file)] == [
            row["devices"] for row in result["rows"]
        ]


def test_hall_coherence_and_seeds(stage):
    result = stage(
        "zero-true",
        schedulers=["max-aoi"],
        topology="hall",
        coherence_slots=5.0,
        seeds=2,
        overhead_bits=24,
        snr_db="20",
    )
    (row,) = result["rows"]
    assert result["topology"] == "hall" and row["devices"] > 0
    assert result["seeds"] == 2 and row["load_ci95"][0] < row["load_per_block"]
    assert row["devices"] == math.floor(row["load_per_block"] * 20e3 / packet_uses(2064 + 24, 20.0))


def test_reports_carry_the_overhead_of_packets(stage):
    result = stage("hold-true", schedulers=["innovation"], overhead_bits=24, snr_db="20")
    (row,) = result["rows"]
    bits = 2064 + 24 + row["reports_per_block_slot"] * (report_bits(row["devices"]) + 24)
    assert row["devices"] == math.floor(row["load_per_block"] * 20e3 * math.log2(101) / bits)
    per_slot = row["packets_per_block_slot"] * 2088 + bits - 2088
    assert row["bits_per_s"] == pytest.approx(1000 * per_slot / row["load_per_block"])


def test_margins_of_a_hall_by_hand(stage, monkeypatch):
    seen = []

    def simulate_cell(*arguments, **tick):
        seen.append((arguments[3], arguments[4]))
        return real(*arguments, **tick)

    real = load_simulator.simulate_cell
    monkeypatch.setattr(load_simulator, "simulate_cell", simulate_cell)
    stage("zero-true", schedulers=["max-aoi"], topology="hall", snr_db="10,20")
    noise_dbm = -174 + 10 * math.log10(20e6) + 6
    drop = drop_devices("InF-SH", 3.75, 300, 0)
    devices, access = seen[-1]  # of the last SNR
    expected = 23 - (20 + noise_dbm + drop.loss_db[:devices])
    assert access.margin_db == pytest.approx(expected, abs=1e-6)
    assert access.k_factor_db == pytest.approx(drop.k_factor_db[:devices])
    assert seen[0][1].margin_db[0] == pytest.approx(expected[0] + 10)  # 10 dB less to reach


def test_noise_is_that_of_a_transmission(stage, monkeypatch):
    """A packet on 3 of 51 blocks of 12 x 30 kHz meets noise on 1.08 MHz, all power is on these."""
    pytest.importorskip("sionna")
    of_one = load_simulator.OneLoad("hold-true", "round-robin", 20.0, 0, 1.0)
    flags = {**SMALL, "radio.phy": "nr", "radio.topology": "hall", "radio.power_dbm": -30.0}
    seen = []

    def simulate_cell(*arguments, **tick):
        seen.append(arguments[4])
        raise StopIteration

    monkeypatch.setattr(load_simulator, "simulate_cell", simulate_cell)
    settings = load_settings(flags=flags)
    with pytest.raises(StopIteration):
        of_one.compute(load_simulator.LoadSimulator(settings, None), lambda steps: None)
    noise_dbm = -174 + 10 * math.log10(3 * 12 * 30e3) + 6
    drop = drop_devices("InF-SH", 3.75, 300, 0)
    margin_db = seen[0].margin_db
    expected_db = -30 - (20 + noise_dbm + drop.loss_db)
    assert margin_db == pytest.approx(expected_db[: len(margin_db)], abs=1e-6)
    share = load_simulator.hall_coverage(settings.radio, 20.0, 0, 300, 3 * 12 * 30e3)
    assert share == pytest.approx((expected_db >= 0).mean())


def test_copies_of_a_sample_carry_more_where_many_are_lost(stage):
    lossy = {"schedulers": ["round-robin"], "power_margin_db": 300.0, "block_error": 0.5}
    fresh, copied = (
        stage("hold-true", harq_rounds=rounds, snr_db="20:25", **lossy)["rows"] for rounds in (1, 3)
    )
    assert copied[0]["load_per_block"] > 1.1 * fresh[0]["load_per_block"]
    assert fresh[0]["curve"] == fresh[1]["curve"]  # of both SNRs
    assert fresh[0]["packets_per_block_slot"] == pytest.approx(0.5, abs=0.1)
    assert copied[0]["packets_per_block_slot"] == pytest.approx(2 / 3, abs=0.1)


def test_a_slot_too_small_for_a_packet_is_said(stage):
    result = stage("hold-true", bandwidth_hz=1e4, snr_db="10")
    assert all(row["devices"] == 0 for row in result["rows"])
    assert "takes 59.7 slots" in result["rows"][0]["reason"]


def test_what_cannot_be_scheduled(stage):
    with pytest.raises(MissingInputError, match="nothing to schedule"):
        stage("optimal")
    with pytest.raises(UsageError, match="supervised-2 needs several slots"):
        stage("hold-true", "supervised-2")


def test_one_step_is_refused_before_anything_is_written(stage, monkeypatch):
    monkeypatch.setitem(SMALL, "protocol.steps", 1)
    with pytest.raises(UsageError, match="steps = 1; law scheduled needs at least 2"):
        stage("hold-true")
    assert not Path("runs").exists()


def test_verify_simulates_both_sides_of_each_load(stage, monkeypatch):
    monkeypatch.setattr(block_loads, "VERIFY_AT", (0.7, 1.4))  # 150 steps fall off slowly
    result = stage("hold-true", schedulers=["round-robin"], seeds=2, verify=True, snr_db="10:20:10")
    (row, _), (inner, outer) = result["rows"], result["verify"]  # the load is that of every SNR
    assert (inner["expected"], outer["expected"]) == ("above", "below")
    assert inner["score"] > inner["ci95"][0] > 0.62 > outer["ci95"][1] > outer["score"]
    for check, share in ((inner, 0.7), (outer, 1.4)):
        assert check["load"] == pytest.approx(share * row["load_per_block"], rel=0.02)
    assert stage.out.getvalue().count(" verified") == 2


def test_verify_goes_beyond_the_largest_load_of_a_search(stage, monkeypatch):
    monkeypatch.setattr(block_loads, "VERIFY_AT", (0.7, 1.4))
    for name in ("BLOCK_DEVICES", "MAX_LOAD"):  # of the teacher beside them
        monkeypatch.setattr(load_simulator, name, 10)
    result = stage("hold-true", schedulers=["round-robin"], verify=True, seeds=2, snr_db="20")
    assert [check["passed"] for check in result["verify"]] == [True, True]


def test_verify_fails_where_the_interval_decides_nothing(stage, monkeypatch):
    monkeypatch.setattr(block_loads, "VERIFY_AT", (0.95,))
    with pytest.raises(NumericalError, match=r"hold-true, round-robin at 0\.95 x"):
        stage("hold-true", schedulers=["round-robin"], verify=True, snr_db="20")


def test_loads_of_two_seeds_are_compared_seed_by_seed(stage):
    """Both have the same fades and gusts, so the ratio is known better than either load."""
    result = stage("hold-true", schedulers=["round-robin", "max-aoi"], seeds=2, snr_db="20")
    turns, ages = (row["devices_by_seed"] for row in result["rows"])
    (found,) = result["gains"]
    assert (found["method"], found["over"]) == ("hold-true, max-aoi", "hold-true, round-robin")
    ratios = [age / turn for age, turn in zip(ages, turns, strict=True)]
    low, high = found["ratio_ci95"]
    assert low < min(ratios) <= max(ratios) < high
    assert math.sqrt(low * high) == pytest.approx(math.sqrt(ratios[0] * ratios[1]))


@pytest.mark.slow
def test_the_bytes_do_not_depend_on_how_many_work(tmp_path, monkeypatch):
    """The other seeds start from what the first one found, whoever is ready first."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(scale, "enforce", lambda result: None)  # 120 steps verify nothing
    flags = {
        "radio.law": "scheduled",
        "radio.schedulers": ["round-robin", "max-aoi"],
        "radio.seeds": 2,
        "radio.snr_db": "20",
        "methods": ["hold-true"],
    }
    settings, kept = load_settings(flags={**SMALL, "protocol.steps": 120, **flags}), set()
    for count in (0, 1, 2):
        with placed(count):
            result = scale.run(settings, Screen(True, stdout=io.StringIO()), verify=True)
        assert [1 < row["load_per_block"] < 512 for row in result["rows"]] == [True, True]
        assert result["verify"]
        kept.add(json.dumps({key: result[key] for key in ("rows", "gains", "verify")}))
    assert len(kept) == 1


def test_gains_name_the_best_rivals():
    rows = [
        {"snr_db": 20.0, "method": m, "scheduler": s, "devices": n, "devices_ci95": [n - 5, n + 5],
         "at_least": n == 110}
        for m, counts in {
            "hjepa": (100, 150),
            "ts-jepa-1": (90, 120),
            "ts-jepa-4": (95, 110),
            "hold": (0, 0),
            "oracle": (120, 200),
        }.items()
        for s, n in zip(("round-robin", "innovation"), counts, strict=True)
    ]  # fmt: skip
    count = BySimulation(
        load_settings(flags={"methods": ["oracle"]}), Screen(True, stdout=io.StringIO())
    )
    found = {(gain["method"], gain["over"]): gain["ratio"] for gain in count.gains(rows, 20.0)}
    assert found == {
        ("hjepa, innovation", "hjepa, round-robin"): 1.5,
        ("ts-jepa-1, innovation", "ts-jepa-1, round-robin"): 120 / 90,
        ("oracle, innovation", "oracle, round-robin"): 200 / 120,
        ("hjepa, innovation", "ts-jepa-1, innovation"): 150 / 120,
        ("hjepa, innovation", "oracle, innovation"): 0.75,
    }
    assert count.gains(rows, 10.0) == []


def test_a_report_shows_every_scheduler(stage, tmp_path):
    result = stage("hold-true", schedulers=["round-robin", "max-aoi"], snr_db="20")
    page = tmp_path / "report.html"
    report.run(Screen(quiet=True), [Path(result["csv"]).parent], out=page)
    shown = re.sub(r"<[^>]+>|\s+", " ", page.read_text())
    assert re.search(r"hold-true, max-aoi +hold-true, round-robin +20 +[+-]\d+\.\d %", shown)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--scheduler", "fifo"], "unknown scheduler 'fifo'"),
        (["--scheduler", ","], "no scheduler"),
        (["--coherence-slots", "0.5"], "0.5"),
        (["--power-margin-db", "nan"], "nan"),
        (["--seeds", "0"], "0"),
        (["--topology", "street"], "street"),
        (["--law", "duty", "--topology", "hall"], "--topology is for the law"),
        (["--payload", "pca-8"], "unknown payload 'pca-8'"),
    ],
)
def test_bad_flags(flags, message, tmp_path, monkeypatch, capsys):
    shell = open_shell(tmp_path, monkeypatch, capsys)
    with shell.untouched():
        outcome = shell("scale", "--law", "scheduled", *flags)
    assert_one_line_error(outcome, 2, message)


@pytest.mark.parametrize(
    "change",
    [
        {"radio.carrier_ghz": 0.4},
        {"radio.carrier_ghz": 101.0},
        {"radio.block_error": 0.6},
        {"radio.coherence_slots": 0.0},
        {"radio.overhead_bits": -1},
        {"radio.schedulers": []},
    ],
)
def test_bad_settings(change):
    from hjepa_cli.config.checks import check_settings

    with pytest.raises(UsageError):
        check_settings(load_settings(flags=change))


def test_grants_and_reports_of_an_nr_cell(stage):
    """Turns are configured; who decides slot by slot signals 16 grants a slot of the carrier."""
    pytest.importorskip("sionna")
    result = stage("hold-true", schedulers=["round-robin", "innovation"], phy="nr", snr_db="20")
    turns, asked = result["rows"]
    assert (turns["grants"], asked["grants"]) == ("configured", "dynamic")
    assert turns["devices"] == math.floor(turns["load_per_block"] * 34)  # 2 slots, 17 of 3 PRBs
    # Scheduling requests are reserved for everybody, and 32 grants are what 34 blocks leave.
    reserved = asked["devices"] / 8 / 6 * 2 / (2 * 14 * 51)
    assert asked["reports_share"] == pytest.approx(reserved, rel=1e-6)
    room = min(32, 34 * (1 - reserved))
    assert asked["devices"] == pytest.approx(asked["load_per_block"] * room, rel=0.01)
    assert "configured" in stage.out.getvalue() and "dynamic" in stage.out.getvalue()


@pytest.mark.parametrize("fading", ["jakes", "tdl-a"])
def test_moving_devices(stage, fading):
    if fading != "jakes":
        pytest.importorskip("sionna")
    result = stage("hold-true", schedulers=["max-aoi"], fading=fading, speed_m_s=10.0, snr_db="20")
    assert result["rows"][0]["devices"] > 0
    assert f"{fading} at 10 m/s" in stage.out.getvalue()
