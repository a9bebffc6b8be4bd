"""The page about matching a camera finds the sensor that it hides."""

import tomllib

import pytest
from command_line import block

from hjepa_cli.config.schema import SensorSettings
from hjepa_cli.config.settings import load_settings


def test_the_page_finds_what_it_hides(tmp_path, capsys):
    found = {}
    exec(compile(block("how-to/real_camera.md", "hidden"), "real_camera.md", "exec"), found)
    text = capsys.readouterr().out
    (tmp_path / "sensor.toml").write_text(text)
    sensor = load_settings(config=tmp_path / "sensor.toml").sensor
    hidden = found["hidden"]
    assert isinstance(hidden, SensorSettings) and tomllib.loads(text)["sensor"]["bayer"] is True
    assert sensor.white == pytest.approx(hidden.white, rel=0.01)
    assert sensor.vignette == pytest.approx(hidden.vignette, abs=0.01)
    assert sensor.shot_noise == pytest.approx(hidden.shot_noise, rel=0.1)
    assert sensor.read_noise == pytest.approx(hidden.read_noise, rel=0.15)
