"""Settings: default < preset < config < flags, with every mistake named."""

import dataclasses
import json
import re
import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hjepa_cli.config.checks import check_settings, resolve
from hjepa_cli.config.schema import (
    OFF,
    PAPER_PROTOCOL,
    ControlSettings,
    RadioSettings,
    Settings,
    declared,
    dotted,
    unsaid,
)
from hjepa_cli.config.settings import PRESETS, load_settings, origins
from hjepa_cli.core.plants.control_law import ceiling_law, control_law
from hjepa_cli.core.plants.named import plant as named
from hjepa_cli.errors import DataError, MissingInputError, UsageError
from hjepa_cli.stages.train_encoder import ARCHITECTURE
from hjepa_cli.storage.runs import to_toml


def preset_file(name: str) -> dict[str, Any]:
    text = (resources.files("hjepa_cli.config") / f"presets/{name}.toml").read_text("utf-8")
    return tomllib.loads(text)


def tuned_laws() -> dict[str, Any]:
    return tomllib.loads((resources.files("hjepa_cli.config") / "control_laws.toml").read_text())


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_loads_and_says_what_it_is(preset: str) -> None:
    settings = load_settings(preset)
    assert settings.preset == preset
    changes = {} if preset == "default" else dotted(preset_file(preset))
    changes = {key: value for key, value in changes.items() if value != []}  # as by default
    paper = {key: changes.pop(key) for key in list(changes) if key.startswith("protocol.paper.")}
    plain = Settings(plant=settings.plant).as_dict()  # which has more of a recorded one
    expected = dotted(plain) | changes | {"preset": preset}
    if preset != "paper":  # which says that there is none
        law = tuned_laws().get(settings.plant, {})
        expected |= {f"control.{name}": gains for name, gains in law.items()}
    for key, off in OFF.items():  # of what is off nothing is said
        if expected.get(key) == off:
            del expected[key]
    if "augment.strength" not in expected:
        expected = {key: value for key, value in expected.items() if "augment." not in key}
    assert dotted(settings.as_dict()) == expected
    # The paper's protocol sets its own values over the preset's, and no others.
    expected |= {f"protocol.{key}": value for key, value in PAPER_PROTOCOL.items()}
    expected |= {key.replace(".paper.", "."): value for key, value in paper.items()}
    assert dotted(load_settings(preset, flags={"protocol": "paper"}).as_dict()) == expected


@pytest.mark.parametrize("preset", PRESETS)
def test_settings_come_back_from_the_file_that_is_written_of_them(
    preset: str, tmp_path: Path
) -> None:
    settings = load_settings(preset, flags={"seed": 7, "protocol": "paper"})
    (tmp_path / "c.toml").write_text(to_toml(settings.as_dict()))
    assert load_settings(preset, tmp_path / "c.toml") == settings


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
    with pytest.raises(UsageError, match=r"unknown setting .protocol\.paper."):
        load_settings(config=config)


def test_a_plant_comes_with_the_law_that_was_tuned_for_it(tmp_path: Path) -> None:
    """Under whatever preset, but for those that say otherwise; a file may say so too."""
    laws = tuned_laws()
    assert set(laws) == {"desktop", "gym", "quadrotor"}
    for plant, law in laws.items():
        for preset in (None, "smoke", "default"):
            control = load_settings(preset, flags={"plant": plant}).control
            assert list(control.gains_n) == law["gains_n"], (plant, preset)
            assert list(control.ceiling_gains_n) == law["ceiling_gains_n"], (plant, preset)
            control_law(named(plant), control)  # which refuses one that does not hold it
            ceiling_law(named(plant), control)
    assert origins()["control.gains_n"] == "tuned law of desktop"
    for settings in (load_settings("paper"), load_settings("recorded")):
        assert settings.control == ControlSettings()
    config = tmp_path / "c.toml"
    config.write_text("[control]\ngains_n = []\n")
    own = load_settings(config=config).control
    assert own.gains_n == () and list(own.ceiling_gains_n) == laws["desktop"]["ceiling_gains_n"]


def test_what_a_record_does_not_say_was_off() -> None:
    """It is not what is on by default, or was tuned, by now."""
    flags = {"encoder.photometric": "none", "augment.strength": 0.0, "control.gains_n": ()}
    flags["control.ceiling_gains_n"] = ()
    of_pictures = {key for key in OFF if key.startswith("augment.")} - {"augment.strength"}
    flags |= {key: OFF[key] for key in of_pictures}
    settings = load_settings(flags=flags)
    said = dotted(settings.as_dict())
    assert not said.keys() & OFF.keys()
    recorded = {key: value for key, value in said.items() if key != "preset"}
    assert load_settings(flags=unsaid(settings.as_dict()) | recorded) == settings
    assert load_settings(flags=recorded) != settings
    on = load_settings(flags={"protocol.delay_steps": 2, "augment.strength": 0.5})
    kept = {"protocol.delay_steps", "augment.strength", "encoder.photometric"}
    kept |= {"control.gains_n", "control.ceiling_gains_n"} | of_pictures
    kept -= {"augment.force_steps"}  # it always was what it is, and counts for nothing when off
    assert unsaid(on.as_dict()) == {key: off for key, off in OFF.items() if key not in kept}


def test_the_defaults_are_those_of_the_papers() -> None:
    """Values that the papers state: those of TS-JEPA's simulation and of the hierarchy."""
    settings = load_settings()
    assert (settings.encoder.h, settings.hierarchy.m, settings.hierarchy.l) == (4, 2, 1)
    assert settings.encoder.ema_decay == 0.99 and settings.radio.bandwidth_hz == 20e6
    protocol = load_settings(flags={"protocol": "paper"}).protocol
    assert (protocol.warmup_steps, protocol.steps, protocol.bracket_devices) == (0, 1000, 256)
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
    load_settings("paper", flags={"collect.steps": 7})
    law = ControlSettings(**{name: tuple(of) for name, of in tuned_laws()["desktop"].items()})
    expected = Settings(control=law)
    assert load_settings() == load_settings(None) == load_settings("default") == expected
    assert load_settings().collect.steps == 160


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("sead = 1", r"unknown setting 'sead' in .*c\.toml, line 1; did you mean 'seed'"),
        ("qqq = 1", "unknown setting 'qqq'.*valid keys: plant, seed"),
        ("seed = 1\n[colect]\nsteps = 1", "'colect' in .*, line 2; did you mean 'collect'"),
        ("[collect]\n\nstep = 1", "'collect.step' in .*, line 3; did you mean 'collect.steps'"),
        ("collect = 1", "'collect' in .*, line 1 is a section, not a value"),
        ("[seed]\na = 1", "'seed' in .*, line 1 is a value, not a section"),
        ('preset = "paper"', "unknown setting 'preset'"),
        ('plant = "moon"', "plant = 'moon' in .*, line 1; choose one of desktop, gym"),
        ("[collect]\nsteps = 1.5", r"collect\.steps = 1\.5 in .*, line 2; expected a whole number"),
        ("collect.steps = true", r"collect\.steps = True in .*, line 1; expected a whole number"),
        ("collect = { steps = '5' }", r"collect\.steps = '5' in .*c\.toml; expected a whole"),
        ("[collect]\nsteps = 1", r"collect\.steps = 1 in .*; expected .* from 2 to"),
        ("[collect]\nx_m = nan", r"collect\.x_m = nan in .*; expected a finite number"),
        ("[collect]\nx_m = inf", "expected a finite number of at least 0"),
        ("[collect]\nx_m = true", "expected a finite number"),
        ("[radio]\ncarrier_ghz = 0.1", "expected a finite number from 0.5 to 100"),
        ("[actor]\ndropout = 1.0", "expected a finite number of at least 0 and less than 1"),
        ("[encoder]\ngate = 1", r"encoder\.gate = 1 in .*; expected true or false"),
        ('device = "tpu"', "device = 'tpu' in .*, line 1; .*choose one of auto, cpu, cuda"),
        ("[protocol]\ngaps = 3", "expected a list"),
        ('[protocol]\ngaps = [1, "2"]', r"protocol\.gaps\[1\] = '2' in .*, line 2; expected a who"),
        ("[protocol]\nsteps = 1\n[protocol.noise]\na = 1", "'protocol.noise'.* line 3 is a value"),
    ],
)
def test_mistakes_in_a_config_are_named(tmp_path: Path, text: str, match: str) -> None:
    (tmp_path / "c.toml").write_text(text)
    with pytest.raises(UsageError, match=match) as caught:
        load_settings(config=tmp_path / "c.toml")
    assert "\n" not in caught.value.message


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ('methods = ["oracel"]', r"'oracel' in .*, line 1; did you mean 'oracle'. choose from hje"),
        ("methods = []", "no method given in .*, line 1; choose from hjepa"),
        ('[radio]\nschedulers = ["round-robbin"]', "line 2; did you mean 'round-robin'"),
        ("[radio]\nschedulers = []", "no scheduler given in .*, line 2; choose from round-robin"),
        ('[radio]\nlaw = "sheduled"', "radio.law = 'sheduled' in .*, line 2; did you mean 'sched"),
        ('plant = "deskop"', "plant = 'deskop' in .*, line 1; did you mean 'desktop'"),
        ('[encoder]\nmirror = "exat"', r"line 2; did you mean 'exact'. choose one of exact, aug"),
        ('[protocol]\npayload = "int99"', "unknown payload 'int99' in .*, line 2; choose float32"),
        ('[protocol]\npayload = "flot16"', r"line 2; did you mean 'float16'. choose float32"),
        ("[protocol]\ngaps = []", r"protocol.gaps = \[\] in .*, line 2; expected ascending"),
        ("[hierarchy]\nm = 3", "--m 3 does not divide --h 4 in .*, line 2; choose --m from 1"),
        ("[encoder]\nframes = 7", "--frames 7 in .*, line 2; method jepa takes 2"),
        ('plant = "quadrotor"\n[conditions]\npole_length = 2', "pole_length = 2 in .*, line 3; "),
    ],
)
def test_rules_name_the_file_the_line_and_the_nearest_name(
    tmp_path: Path, text: str, match: str
) -> None:
    (tmp_path / "c.toml").write_text(text)
    with pytest.raises(UsageError, match=match) as caught:
        resolve(None, tmp_path / "c.toml", {"plant": None})
    assert str(caught.value) == caught.value.message and "\n" not in caught.value.message


@pytest.mark.parametrize(
    "text",
    [
        'methods = ["""\nseed = 1\n"""]\nseed = -1',  # a line within a text
        "seed = -1\nmethods = [\nseed = 1\n]",  # no TOML, but two lines that look like it
    ],
)
def test_a_line_that_is_not_certain_is_not_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "c.toml").write_text(text)
    with pytest.raises((UsageError, DataError)) as caught:
        load_settings(config=tmp_path / "c.toml")
    assert "toml, line" not in caught.value.message


def test_values_from_python_meet_the_same_bounds() -> None:
    with pytest.raises(UsageError, match=r"^collect\.steps = 1; expected a whole number"):
        load_settings(flags={"collect.steps": 1})
    settings = load_settings()
    for section, changes, message in (
        ("protocol", {"steps": 0}, "protocol.steps = 0; expected a whole number"),
        ("protocol", {"gaps": (1, 0)}, r"protocol.gaps\[1\] = 0; expected a whole number"),
        ("radio", {"harq_rounds": 17}, "radio.harq_rounds = 17; expected .* from 1 to 16"),
        ("encoder", {"mirror": "no"}, "encoder.mirror = 'no'; .*one of exact, augment, none"),
        ("actor", {"dropout": float("nan")}, "actor.dropout = nan; expected a finite number"),
    ):
        changed = dataclasses.replace(getattr(settings, section), **changes)
        with pytest.raises(UsageError, match=message):
            check_settings(dataclasses.replace(settings, **{section: changed}))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"plant": "nope"}, "plant = 'nope'; choose one of desktop"),
        ({"radio": RadioSettings(law="equale")}, "radio.law = 'equale'; did you mean 'equal'"),
        ({"protocol": None}, "protocol = None; expected a section"),
    ],
)
def test_settings_made_in_python_meet_the_rules_of_names(changes: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        check_settings(dataclasses.replace(load_settings(), **changes))


def test_numbers_of_numpy_are_numbers() -> None:
    flags = {
        "radio.bandwidth_hz": np.float64(5e6),
        "protocol.steps": np.int64(500),
        "protocol.gaps": np.array([1, 5]),
        "encoder.gate": np.bool_(False),
    }
    settings = load_settings(flags=flags)
    assert type(settings.radio.bandwidth_hz) is float and settings.protocol.gaps == (1, 5)
    assert type(settings.protocol.steps) is int and settings.encoder.gate is False
    changed = dataclasses.replace(settings.protocol, steps=np.int64(500), gaps=np.array([1, 5]))
    changed = dataclasses.replace(settings, protocol=changed)
    check_settings(changed)
    assert json.dumps(changed.as_dict()) == json.dumps(settings.as_dict())
    with pytest.raises(UsageError, match=r"protocol\.steps = 1\.5; expected a whole number"):
        load_settings(flags={"protocol.steps": np.float32(1.5)})


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({5: 5}, "unknown setting 5; expected a dotted key"),
        ({"protocol.steps.x": 5}, "'protocol.steps' is a value, not a section"),
        ({"protocol.": 5}, "unknown setting 'protocol.'"),
        ({"collect": 5}, "'collect' is a section, not a value"),
    ],
)
def test_flags_from_python_that_are_none(flags: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        load_settings(flags=flags)


def test_a_config_may_be_named_by_a_text(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text("seed = 5\n")
    assert load_settings(config=str(tmp_path / "c.toml")).seed == 5
    assert origins(config=str(tmp_path / "c.toml"))["seed"] == str(tmp_path / "c.toml")


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
    with pytest.raises(UsageError, match=r"'papper'; did you mean 'paper'. choose .* default, gym"):
        load_settings("papper")
    with pytest.raises(UsageError, match=r"unknown setting .collect\.stepz.; did you mean"):
        load_settings(flags={"collect.stepz": 3})


def test_settings_are_frozen_and_plain() -> None:
    settings = load_settings()
    with pytest.raises(dataclasses.FrozenInstanceError):
        settings.seed = 3  # type: ignore[misc]
    assert isinstance(settings.as_dict()["protocol"]["gaps"], list)
    assert hash(settings) == hash(load_settings())


def test_every_setting_is_read_somewhere() -> None:
    """No dead options: each field is asked for as an attribute, or fits a getattr(f"…").

    An architecture's are read from the checkpoint that records them.
    """
    package = Path(str(resources.files("hjepa_cli")))
    source = "\n".join(path.read_text(encoding="utf-8") for path in package.rglob("*.py"))
    composed = re.findall(r'getattr\([\w.]+, f"([\w{}]+)"', source)
    patterns = [re.sub(r"{\w+}", r"\\w+", name) for name in composed]

    def is_read(name: str) -> bool:
        return bool(re.search(rf"\.{name}\b", source)) or any(
            re.fullmatch(pattern, name) for pattern in patterns
        )

    names = {key.rpartition(".")[2] for key in declared()}
    dead = sorted(name for name in names - set(ARCHITECTURE) if not is_read(name))
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
