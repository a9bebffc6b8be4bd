"""A scheduler and a sharing law, each from one file outside of the package, through ``scale``."""

import csv
import io
import math

import pytest
from command_line import block

from hjepa_cli import plugins
from hjepa_cli.cli import flags
from hjepa_cli.config.checks import check_cell, check_settings
from hjepa_cli.config.schema import RadioSettings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.errors import UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import scale

SCHEDULER = block("plugins.md", "Scheduler(")
LAW = block("plugins.md", "ClosedFormLaw(")
PHY = block("plugins.md", "register(Phy(")
TINY = {
    "protocol": "paper",
    "protocol.steps": 120,
    "protocol.gaps": (1, 40, 80),
    "protocol.bracket": 0.2,
    "protocol.bootstrap": 200,
    "radio.snr_db": "20",
    "methods": ("hold-true", "oracle"),
}


@pytest.fixture
def load(tmp_path, monkeypatch):
    """Load plugins from text, in an empty directory and for one test."""
    monkeypatch.chdir(tmp_path)
    for registry in (plugins.SCHEDULERS, plugins.LAWS, plugins.PHYS):
        monkeypatch.setattr(registry, "_added", {})
    monkeypatch.setattr(plugins, "_sources", [])

    def load(text):
        (tmp_path / "mine.py").write_text(text)
        return plugins.load_file(tmp_path / "mine.py")

    return load


def counted(screen=None, verify=False, **radio):
    settings = load_settings("smoke", flags=TINY | {f"radio.{key}": radio[key] for key in radio})
    check_settings(settings)
    return scale.run(settings, screen or Screen(True, stdout=io.StringIO()), verify=verify)


def test_a_scheduler_from_a_file(load):
    load(SCHEDULER)
    out = io.StringIO()
    result = counted(
        Screen(True, stdout=out), law="scheduled", schedulers=("round-robin", "patient")
    )
    loads = {(row["method"], row["scheduler"]): row["load_per_block"] for row in result["rows"]}
    assert len(loads) == 4 and min(loads.values()) > 1
    assert "oracle, patient" in out.getvalue()
    assert ("hold-true, patient", "hold-true, round-robin") in {
        (gain["method"], gain["over"]) for gain in result["gains"]
    }
    pytest.importorskip("matplotlib")
    assert len(result["figures"]) == 3  # PNG, SVG, PDF


def test_a_law_from_a_file(load):
    load(LAW)
    out = io.StringIO()
    half = counted(Screen(True, stdout=out), law="half-duty", snr_db="10,20")
    duty = counted(law="duty", snr_db="10,20")
    for ours, theirs in zip(half["rows"], duty["rows"], strict=True):
        c = 20e3 * math.log2(1 + 10 ** (ours["snr_db"] / 10)) / 2064
        assert ours["devices"] == math.floor(ours["tolerance"] * c / 2) > 0
        assert ours["tolerance"] == theirs["tolerance"] and not ours["reason"]
        assert ours["bits_per_s"] == pytest.approx(2064e3 / ours["tolerance"])
    assert "devices: half-duty law" in out.getvalue() and "gap D* [steps]" in out.getvalue()
    with open(half["csv"]) as file:
        assert [int(row["devices"]) for row in csv.DictReader(file)] == [
            row["devices"] for row in half["rows"]
        ]


def test_a_physical_layer_from_a_file(load):
    load(PHY)
    out = io.StringIO()
    less = counted(Screen(True, stdout=out), phy="two-thirds", snr_db="10,20")
    for ours, theirs in zip(less["rows"], counted(snr_db="10,20")["rows"], strict=True):
        assert abs(ours["devices"] - 2 / 3 * theirs["devices"]) < 1
        assert ours["tolerance"] == theirs["tolerance"]
    assert less["phy"] == "two-thirds" and "capacity of two thirds" in out.getvalue()
    scheduled = counted(phy="two-thirds", law="scheduled", schedulers=("round-robin",))["rows"]
    assert all(row["devices"] > 0 for row in scheduled)
    with pytest.raises(UsageError, match="physical layer shannon, this is two-thirds"):
        counted(phy="two-thirds", law="scheduled", overhead_bits=24)


def test_a_law_from_a_file_has_the_flags_of_its_kind(load):
    load(LAW)
    half = RadioSettings(law="half-duty")
    check_cell(half, {"remeasure": True, "radio.snr_db": "10"})
    with pytest.raises(UsageError, match="--noise is for the law equal, this is half-duty"):
        check_cell(half, {"radio.noise": "fixed"})
    with pytest.raises(UsageError, match="--remeasure is for the law duty or equal or half-duty"):
        check_cell(RadioSettings(law="scheduled"), {"remeasure": True})
    with pytest.raises(UsageError, match="'hall' is for the law scheduled, this is half-"):
        counted(law="half-duty", topology="hall")


def test_a_law_that_nobody_fits_into_says_so(load):
    load(LAW)
    row = counted(law="half-duty", bandwidth_hz=1e3)["rows"][0]
    assert row["devices"] == 0 and row["reason"].startswith("a packet takes 310 slots")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (LAW.replace("axis=GAP, ", ""), r"mine.py:\d+: TypeError: .*'axis'"),
        (LAW.replace("half-duty", "duty"), r"mine.py:\d+: there is a law called 'duty' already"),
        (SCHEDULER.replace("lambda view: np.where(view.able, view.waited, 0.0)", "None"), "score"),
    ],
)
def test_half_a_plugin_is_refused(load, text, says):
    with pytest.raises(UsageError, match=says):
        load(text)
    assert "patient" not in plugins.SCHEDULERS and "half-duty" not in plugins.LAWS


def test_unknown_names_are_refused_with_those_that_there_are(load):
    with pytest.raises(UsageError, match="choose one of duty, equal, scheduled"):
        counted(law="half-duty")
    load(LAW)
    with pytest.raises(UsageError, match="choose one of duty, equal, scheduled, half-duty"):
        counted(law="third-duty")
    with pytest.raises(UsageError, match="unknown scheduler 'patient'; choose from round-robin, "):
        counted(law="scheduled", schedulers=("patient",))


def test_the_help_of_the_flag_says_what_each_law_does():
    text = flags.taken("radio.law").help
    for name in ("duty", "equal", "scheduled"):
        assert plugins.LAWS[name].help in text
        assert plugins.LAWS[name].name == name


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("from hjepa_cli import register\nregister(print)", "mine.py:2: .*extends nothing; make "),
        (
            "import types\nfrom hjepa_cli import register\n"
            "register(types.SimpleNamespace(name='half', score=None))",
            "mine.py:3: .*extends nothing; make it with System, Codec, ",
        ),
        (
            "from hjepa_cli import register\nfrom hjepa_cli.core.plants.system import System\n"
            "class Half(System):\n    name = 'half'\nregister(Half())",
            "mine.py:5: TypeError: .*abstract.* advance",
        ),
    ],
)
def test_what_is_made_with_nothing_of_the_package_is_refused(load, text, says):
    with pytest.raises(UsageError, match=says):
        load(text)
    assert "half" not in plugins.PLANTS
