"""What a radio cell refuses, in one line and with exit code 2; and what it honestly counts as 0."""

import math
import tomllib

import numpy as np
import pytest
from command_line import assert_one_line_error, open_shell

import hjepa_cli
from hjepa_cli.core.control.error_growth import ErrorGrowthTable
from hjepa_cli.core.radio.channel import line_of_sight_probability, path_loss_db
from hjepa_cli.core.radio.factory_hall import drop_devices
from hjepa_cli.core.radio.uplink import Access, Uplink
from hjepa_cli.errors import UsageError

SH = {
    "clutter_density": 0.2,
    "clutter_size_m": 10.0,
    "clutter_height_m": 2.0,
    "bs_height_m": 8.0,
    "ue_height_m": 1.5,
}
CELL = ("scale", "--law", "scheduled", "--methods", "hold-true", "--snr", "20:20")


@pytest.fixture
def shell(tmp_path, monkeypatch, capsys):
    return open_shell(tmp_path, monkeypatch, capsys)


def uplink(blocks, devices):
    growth = ErrorGrowthTable(np.ones(1))
    return Uplink(Access("max-aoi", blocks, 10.0, -math.inf, 1.0, (0.0,), growth, 0), devices)


@pytest.mark.parametrize(
    ("refused", "message"),
    [
        (lambda: path_loss_db("InF-SH", 3.75, 0.9), "3D distance"),
        (lambda: path_loss_db("InF-SH", 3.75, 601.0), "3D distance"),
        (lambda: path_loss_db("InF-SH", 0.4, 50.0), "carrier frequency"),
        (lambda: path_loss_db("InF-SH", 101.0, 50.0), "carrier frequency"),
        (
            lambda: line_of_sight_probability("InF-SH", 50.0, **SH | {"clutter_density": 1.0}),
            "clutter density",
        ),
        (
            lambda: line_of_sight_probability("InF-SH", 50.0, **SH | {"clutter_density": -0.1}),
            "clutter density",
        ),
        (
            lambda: line_of_sight_probability("InF-SH", 50.0, **SH | {"clutter_height_m": 1.5}),
            "not above the device",
        ),
        (lambda: drop_devices("InF-SH", 0.4, 10, 0), "carrier frequency"),
        (lambda: uplink(blocks=11, devices=10), "11 resource blocks for 10 devices"),
        (lambda: uplink(blocks=0, devices=10), "0 resource blocks"),
    ],
)
def test_refused_by_the_functions(refused, message):
    with pytest.raises(UsageError, match=message) as caught:
        refused()
    assert caught.value.exit_code == 2 and "\n" not in caught.value.message


@pytest.mark.parametrize(
    ("flags", "config", "message"),
    [
        (("--bandwidth-mhz", "0"), "", "--bandwidth-mhz"),
        (("--bandwidth-mhz", "-20"), "", "of more than 0"),
        ((), "bandwidth_hz = 0.0", "more than 0"),
        ((), "carrier_ghz = 0.4", "0.5 to 100"),
        ((), "carrier_ghz = 100.5", "0.5 to 100"),
        ((), 'scenario = "InF-XX"', "InF-SH"),
        ((), "block_error = 0.7", "from 0 to 0.5"),
        ((), "harq_rounds = 17", "from 1 to 16"),
        ((), "harq_rounds = 0", "from 1 to 16"),
    ],
)
def test_refused_by_the_command(flags, config, message, shell):
    (shell.directory / "cell.toml").write_text(f"[radio]\n{config}\n")
    with shell.untouched():
        outcome = shell(*CELL, "--topology", "hall", "--config", "cell.toml", *flags)
    assert_one_line_error(outcome, 2, message)


UNREAD = [  # setting, its value in TOML, other settings, what would read it
    ("overhead_bits", "24", {"law": "duty"}, "is for the law scheduled, this is duty"),
    ("block_error", "0.1", {"law": "equal"}, "is for the law scheduled, this is equal"),
    ("harq_rounds", "2", {"law": "duty"}, "is for the law scheduled, this is duty"),
    ("carrier_ghz", "28.0", {"law": "duty"}, "is for the law scheduled, this is duty"),
    ("power_dbm", "10.0", {"law": "duty"}, "is for the law scheduled, this is duty"),
    ("noise_figure_db", "3.0", {"law": "duty"}, "is for the law scheduled, this is duty"),
    ("scenario", '"InF-SL"', {"law": "equal"}, "is for the law scheduled, this is equal"),
    ("power_margin_db", "3.0", {"law": "duty"}, "is for the law scheduled, this is duty"),
    ("coherence_slots", "2.0", {"law": "duty"}, "is for the law scheduled, this is duty"),
    ("topology", '"hall"', {"law": "duty"}, "is for the law scheduled, this is duty"),
    ("seeds", "2", {"law": "duty"}, "is for the law scheduled, this is duty"),
    ("noise", '"scaled"', {"law": "duty"}, "is for the law equal, this is duty"),
    ("noise", '"scaled"', {"law": "scheduled"}, "is for the law equal, this is scheduled"),
    ("scenario", '"InF-SL"', {"law": "scheduled"}, "is for the topology hall, this is target"),
    ("carrier_ghz", "28.0", {"law": "scheduled"}, "is for the topology hall, this is target"),
    (
        *("power_margin_db", "3.0", {"law": "scheduled", "topology": "hall"}),
        "is for the topology target, this is hall",
    ),
    ("harq_rounds", "2", {"law": "scheduled"}, "is for a radio.block_error above 0"),
]


@pytest.mark.parametrize(("name", "value", "others", "says"), UNREAD)
def test_what_the_law_would_not_read_is_refused_from_wherever_it_comes(
    name, value, others, says, shell
):
    lines = [f"{name} = {value}", *(f'{key} = "{other}"' for key, other in others.items())]
    (shell.directory / "cell.toml").write_text("\n".join(["[radio]", *lines]))
    for more in ((), ("--dry-run",)):
        with shell.untouched():
            outcome = shell("scale", "--methods", "oracle", "--config", "cell.toml", *more)
        assert_one_line_error(outcome, 2, f"radio.{name} =", says)
    assert_one_line_error(shell("reproduce", "--config", "cell.toml", "--dry-run"), 2, says)
    given = tomllib.loads(f"x = {value}")["x"]
    values = {f"radio.{key}": other for key, other in others.items()} | {f"radio.{name}": given}
    with pytest.raises(UsageError, match=says):
        hjepa_cli.scale(methods=["oracle"], settings=values)


def test_an_input_that_the_law_would_not_read_is_refused_from_python(shell):
    with pytest.raises(UsageError, match="--remeasure is for the law duty or equal"):
        hjepa_cli.scale(law="scheduled", methods=["oracle"], remeasure=True)


def test_settings_of_a_cell_do_not_concern_other_stages(shell):
    (shell.directory / "cell.toml").write_text('[radio]\ntopology = "hall"\noverhead_bits = 24\n')
    for stage in ("collect", "eval"):
        assert shell(stage, "--config", "cell.toml", "--dry-run").code == 0
    with pytest.raises(UsageError, match="is for the law scheduled"):
        hjepa_cli.scale(config="cell.toml")


def test_valid_settings_that_carry_no_packet_count_0_and_say_why(shell):
    outcome = shell(*CELL, "--bandwidth-mhz", "0.01", "--json")
    assert outcome.code == 0
    for row in outcome.document["rows"]:
        assert row["devices"] == 0 and "a packet takes 31" in row["reason"]
