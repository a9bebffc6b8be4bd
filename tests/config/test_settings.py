"""Settings: default < preset < config < flags, with every mistake named."""

import dataclasses
import re
import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

import pytest

from hjepa_cli.config.settings import PRESETS, Settings, load_settings, origins
from hjepa_cli.errors import DataError, MissingInputError, UsageError


def preset_file(name: str) -> dict[str, Any]:
    text = (resources.files("hjepa_cli") / "presets" / f"{name}.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in values.items():
        path = prefix + key
        found |= flat(value, f"{path}.") if isinstance(value, dict) else {path: value}
    return found


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_loads_and_says_what_it_is(preset: str) -> None:
    settings = load_settings(preset)
    assert settings.preset == preset
    changes = flat(preset_file(preset))
    merged = flat(preset_file("default")) | changes
    paper = {key: merged.pop(key) for key in list(merged) if key.startswith("protocol.paper.")}
    expected = {key: value for key, value in merged.items() if value != []}
    found = flat(settings.as_dict())
    assert found.pop("preset") == preset
    assert found == expected
    # The paper's protocol sets its own values over the preset's, and no others.
    found = flat(load_settings(preset, flags={"protocol": "paper"}).as_dict())
    expected |= {key.replace(".paper.", "."): value for key, value in paper.items()}
    assert found == expected | {"preset": preset}


def test_a_protocol_lies_between_preset_and_file(tmp_path: Path) -> None:
    config = tmp_path / "c.toml"
    config.write_text("[protocol]\nsteps = 500\n")
    protocol = load_settings(config=config, flags={"protocol": "paper"}).protocol
    assert (protocol.warmup_steps, protocol.steps, protocol.bracket_devices) == (0, 500, 256)
    assert protocol.total_steps == 500
    known = origins(config=config, flags={"protocol": "paper"})
    assert known["protocol.warmup_steps"] == "protocol paper"
    assert known["protocol.steps"] == str(config)
    with pytest.raises(UsageError, match="choose one of steady, paper"):
        load_settings(flags={"protocol": "papers"})
    config.write_text("[protocol.paper]\nsteps = 500\n")
    with pytest.raises(UsageError, match="unknown setting 'paper'"):
        load_settings(config=config)


def test_every_shipped_preset_is_listed() -> None:
    folder = resources.files("hjepa_cli") / "presets"
    names = {Path(entry.name).stem for entry in folder.iterdir() if entry.name.endswith(".toml")}
    assert names == set(PRESETS)


def test_the_defaults_are_those_of_the_papers() -> None:
    """Values that spec and paper state; a typo in default.toml would move every result."""
    settings = load_settings()
    assert (settings.plant, settings.encoder.h, settings.encoder.embedding) == ("desktop", 4, 256)
    assert dataclasses.astuple(settings.hierarchy)[:3] == (4, 2, 1)
    assert settings.encoder.ema_decay == 0.99 and settings.encoder.rollout_steps == 80
    collect = settings.collect
    assert (collect.trajectories, collect.test_trajectories, collect.clean_trajectories) == (
        200,
        40,
        40,
    )
    assert (collect.x_m, collect.x_dot_m_s, collect.theta_rad, collect.theta_dot_rad_s) == (
        0.1,
        0.5,
        0.35,
        5.0,
    )
    protocol = settings.protocol
    assert protocol.gaps == (1, 20, 40, 80, 120, 160, 240, 320)
    assert (protocol.warmup_steps, protocol.steps) == (1000, 3000)
    paper = load_settings(flags={"protocol": "paper"}).protocol
    assert (paper.warmup_steps, paper.steps, paper.bracket_devices) == (0, 1000, 256)
    assert protocol.acceptable_score == 0.62 and protocol.acceptable_lq_ratio == 0.5
    assert settings.radio.bandwidth_hz == 20e6 and settings.radio.snr_db == "10:30"
    paper = load_settings("paper")
    assert paper.encoder.learning_rate == 9e-3 and paper.encoder.rollout_steps == 15


def test_precedence(tmp_path: Path) -> None:
    config = tmp_path / "c.toml"
    config.write_text("seed = 5\n[collect]\nsteps = 60\ntrajectories = 9\n")
    assert load_settings().collect.trajectories == 200
    assert load_settings("smoke").collect.trajectories == 24
    from_config = load_settings("smoke", config)
    assert (from_config.collect.trajectories, from_config.seed) == (9, 5)
    assert from_config.collect.test_trajectories == 8, "the preset below it still counts"
    flags = {"collect.trajectories": 3, "seed": None, "collect.steps": None}
    settings = load_settings("smoke", config, flags)
    assert (settings.collect.trajectories, settings.seed, settings.collect.steps) == (3, 5, 60)


def test_loading_twice_is_independent() -> None:
    load_settings("paper", flags={"collect.steps": 1})
    assert load_settings() == load_settings(None) == load_settings("default")
    assert load_settings().collect.steps == 100


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("sead = 1", r"unknown setting 'sead' in .*c\.toml; did you mean 'seed'"),
        ("qqq = 1", "unknown setting 'qqq'.*valid keys: plant, seed"),
        ("[colect]\nsteps = 1", "unknown setting 'colect'.*did you mean 'collect'"),
        ("[collect]\nstep = 1", r"'step'.*section \[collect\]; did you mean 'steps'"),
        ("collect = 1", "'collect' in .* is a section, not a value"),
        ('preset = "paper"', "unknown setting 'preset'"),
        ('plant = "moon"', "plant = 'moon'; choose one of desktop, gym"),
        ("[collect]\nsteps = 1.5", r"collect\.steps = 1\.5; expected a whole number"),
        ("[collect]\nsteps = true", r"collect\.steps = True; expected a whole number"),
        ('[collect]\nsteps = "5"', r"collect\.steps = '5'; expected a whole number"),
        ("[collect]\nx_m = nan", r"collect\.x_m = nan; expected a finite number"),
        ("[collect]\nx_m = inf", "expected a finite number"),
        ("[collect]\nx_m = true", "expected a number"),
        ("[encoder]\ngate = 1", r"encoder\.gate = 1; expected true or false"),
        ("[protocol]\ngaps = 3", "expected a list"),
        ('[protocol]\ngaps = [1, "2"]', r"protocol\.gaps = '2'; expected a whole number"),
    ],
)
def test_mistakes_in_a_config_are_named(tmp_path: Path, text: str, match: str) -> None:
    (tmp_path / "c.toml").write_text(text)
    with pytest.raises(UsageError, match=match) as caught:
        load_settings(config=tmp_path / "c.toml")
    assert "\n" not in caught.value.message


def test_whole_numbers_serve_as_floats(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text("[collect]\nx_m = 1\n")
    x_m = load_settings(config=tmp_path / "c.toml").collect.x_m
    assert x_m == 1.0 and type(x_m) is float


def test_config_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match=r"gone\.toml does not exist"):
        load_settings(config=tmp_path / "gone.toml")
    for data in (b"= 1", b"\xff\xfe", b"a = 1\na = 2"):
        (tmp_path / "c.toml").write_bytes(data)
        with pytest.raises(DataError, match="not readable TOML"):
            load_settings(config=tmp_path / "c.toml")
    with pytest.raises(DataError, match="not readable TOML"):
        load_settings(config=tmp_path)


def test_unknown_preset_and_flag() -> None:
    with pytest.raises(UsageError, match="unknown preset 'papper'; choose one of default, gym"):
        load_settings("papper")
    with pytest.raises(UsageError, match="unknown setting 'stepz' in flag"):
        load_settings(flags={"collect.stepz": 3})


def test_settings_are_frozen_and_plain() -> None:
    settings = load_settings()
    with pytest.raises(dataclasses.FrozenInstanceError):
        settings.seed = 3  # type: ignore[misc]
    assert isinstance(settings.as_dict()["protocol"]["gaps"], list)
    assert hash(settings) == hash(load_settings())


def test_every_setting_is_read_somewhere() -> None:
    """No dead options: each field is asked for as an attribute, or fits a getattr(f"…")."""
    package = Path(str(resources.files("hjepa_cli")))
    source = "\n".join(path.read_text(encoding="utf-8") for path in package.rglob("*.py"))
    composed = re.findall(r'getattr\([\w.]+, f"([\w{}]+)"', source)
    patterns = [re.sub(r"{\w+}", r"\\w+", name) for name in composed]

    def is_read(name: str) -> bool:
        return bool(re.search(rf"\.{name}\b", source)) or any(
            re.fullmatch(pattern, name) for pattern in patterns
        )

    sections = [field.type for field in dataclasses.fields(Settings)]
    kinds = [Settings, *(kind for kind in sections if dataclasses.is_dataclass(kind))]
    assert len(kinds) == 9
    names = {field.name for kind in kinds for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    dead = sorted(name for name in names if not is_read(name))
    assert not dead, f"settings that nobody reads: {dead}"


def test_a_plant_alone_means_its_preset(tmp_path) -> None:
    """In a file as on the command line: the other plant's ranges and noise fit no better there."""
    (tmp_path / "gym.toml").write_text('plant = "gym"\n[protocol]\ncurve_devices = 7\n')
    expected = load_settings("gym", flags={"protocol.curve_devices": 7})
    assert load_settings(config=tmp_path / "gym.toml") == expected
    assert load_settings(flags={"plant": "gym"}) == load_settings("gym")
    assert origins(config=tmp_path / "gym.toml")["protocol.steps"] == "preset gym"
    named = load_settings("default", tmp_path / "gym.toml")  # whoever names another wants it
    assert named.protocol.steps == load_settings("default").protocol.steps
    flag = load_settings(config=tmp_path / "gym.toml", flags={"plant": "desktop"})
    assert (flag.preset, flag.plant) == ("default", "desktop")
