"""Plants of plugins are looked at when they answer, and what they are given is a copy."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import block

from hjepa_cli import plugins
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.plants.system import System
from hjepa_cli.errors import ArrayError, UsageError

PENDULUM = block("own_plant.md", "class Pendulum")
STATES, FORCES_N = np.array([[0.02, 0.0], [0.3, 0.1], [-0.1, 1.0]]), np.array([0.1, -2.0, 0.0])
BAND = "np.abs(states[..., 0]) <= 0.1"
COST = "stage_cost(states, forces_n, (10.0, 0.1), 0.1)"
LAW = "-(np.asarray(states) * gain).sum(-1).clip(-limit_n, limit_n)"
MOVED = "np.stack([theta, half + self.step_s / 2 * theta_ddot(theta)], axis=-1)"
PICTURES = "draw([Rod(*self.ends(states), 5.0, (160, 0, 0))])"
MANIFEST = '{"version": 1, "length_px": self.length_px}'
SKETCH = "[np.concatenate(self.ends(np.asarray(state)[None]))]"
FALLEN = "    def fallen(self, states):\n        return np.abs(states[..., 0]) > 0.2\n\n"
WITH_FALLEN = PENDULUM.replace("    def in_band(", FALLEN + "    def in_band(")
ASKED = {
    "fallen": lambda kind: kind.fallen(STATES),
    "in_band": lambda kind: kind.in_band(STATES),
    "cost": lambda kind: kind.cost(STATES, FORCES_N),
    "teacher": lambda kind: kind.teacher()(STATES),
    "advance": lambda kind: kind.advance(STATES, FORCES_N),
    "simulation": lambda kind: kind.simulation(3, mass_scale=np.ones((3, 2))).states,
    "render": lambda kind: kind.camera().render(STATES),
    "manifest": lambda kind: kind.camera().manifest(),
    "sketch_px": lambda kind: kind.camera().sketch_px(STATES[0]),
}


@pytest.fixture(autouse=True)
def no_plugins(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Whatever a test loads is gone after it."""
    monkeypatch.setattr(plugins.PLANTS, "_added", {})
    monkeypatch.setattr(plugins, "_sources", [])
    yield
    for name in [name for name in sys.modules if name.startswith("hjepa_plugin")]:
        del sys.modules[name]


def loaded(directory: Path, text: str) -> System:
    """Write a plugin's file, load it as ``--plugin`` does, and return its plant."""
    (directory / "mine.py").write_text(text)
    plugins.load_file(directory / "mine.py")
    return plant("pendulum")


def test_sound_answers_come_back_as_they_were_made(tmp_path: Path) -> None:
    kind = loaded(tmp_path, WITH_FALLEN)
    answers: dict[str, Any] = {name: asked(kind) for name, asked in ASKED.items()}
    assert answers["fallen"].tolist() == [False, True, False]
    assert answers["in_band"].tolist() == [True, False, True]
    assert not kind.fallen(STATES[0]) and kind.cost(STATES[0], FORCES_N[0]) > 0  # as in gym
    assert kind.advance(STATES[None], FORCES_N[None]).shape == (1, 3, 2)
    assert answers["render"].dtype == np.uint8 and answers["manifest"]["version"] == 1


@pytest.mark.parametrize(
    ("asked", "old", "new", "says"),
    [
        ("fallen", "> 0.2", "* 1.0", "float64 .* expected bool, as of a comparison"),
        ("fallen", "states[..., 0]) > 0.2", "states) > 0.2", r"\(3, 2\) of bool; .* \(3,\)"),
        ("in_band", BAND, "True", r"in_band\(…\) is \(\) of bool"),
        ("in_band", BAND, f"({BAND}).astype(int)", "int64 .* expected bool"),
        ("in_band", BAND, "None", r"in_band\(…\) is \(\) of object"),
        ("cost", COST, f"{COST} * np.nan", r"cost\(…\)\[0\] is nan"),
        ("cost", COST, f"-{COST}", "expected 0 to 50"),
        ("cost", COST, f"1e4 * {COST}", "expected 0 to 50"),
        ("cost", COST, f"{COST}.sum()", r"cost\(…\) is \(\)"),
        ("teacher", LAW, "-(np.asarray(states) * gain)", r"teacher\(\)\(…\) is \(3, 2\)"),
        ("teacher", LAW, "-99.0 * np.asarray(states)[..., 0]", "expected -2 to 2"),
        ("teacher", f"lambda states: {LAW}", "None", r"teacher\(\) made None; expected a function"),
        ("advance", MOVED, "theta", r"advance\(…\) is \(3,\)"),
        ("advance", MOVED, f"{MOVED} * np.nan", r"advance\(…\)\[0, 0\] is nan"),
        ("simulation", "Integrated(self, self.advance, devices, mass_scale)", "0", "no attribute"),
        ("simulation", ", devices, mass_scale)", ", 1, None)", r"states is \(1, 2\)"),
        ("simulation", ", *, mass_scale=None", "", "TypeError"),
        ("render", PICTURES, f"{PICTURES} / 255", "float64 .* from 0 to 1; expected uint8"),
        ("render", PICTURES, f"{PICTURES}[0]", r"render\(…\) is \(64, 128, 3\) of uint8"),
        ("manifest", MANIFEST, "{1, 2}", r"manifest\(\) is not plain"),
        ("manifest", MANIFEST, "None", r"manifest\(\) is None; expected a dict"),
        ("sketch_px", SKETCH, "[state]", r"line of sketch_px\(…\) is \(2,\)"),
        ("sketch_px", SKETCH, "[]", "no line"),
        ("sketch_px", "def sketch_px", "def sketched", r"which has no sketch_px\(…\)"),
    ],
)
def test_a_plant_that_answers_wrong_is_named(
    tmp_path: Path, asked: str, old: str, new: str, says: str
) -> None:
    assert old in WITH_FALLEN
    kind = loaded(tmp_path, WITH_FALLEN.replace(old, new))
    with pytest.raises(UsageError, match=rf"^plugin .*mine\.py: plant 'pendulum': .*{says}"):
        ASKED[asked](kind)


def test_a_plant_that_was_never_registered_is_looked_at_too(tmp_path: Path) -> None:
    kind = loaded(tmp_path, PENDULUM.replace(BAND, "True"))
    plugins.PLANTS._added.clear()
    with pytest.raises(ArrayError, match=r"^in_band\(…\) is \(\) of bool"):
        kind.in_band(STATES)


IN_PLACE = """
class Moving:
    def __init__(self, system, devices):
        self.system, self.states = system, np.zeros((devices, 2))

    def step(self, forces_n):
        forces_n *= 1.0
        self.states += 1.0
"""


def test_what_a_plant_does_to_its_arrays_is_its_own(tmp_path: Path) -> None:
    """A simulation that moves its states in place moved those that a camera has yet to see."""
    text = PENDULUM.replace("@dataclasses", IN_PLACE + "\n\n@dataclasses", 1)
    text = text.replace("Integrated(self, self.advance, devices, mass_scale)", "Moving(self, 3)")
    text = text.replace(f"return {BAND}", f"states[..., 0] %= 0.25\n        return {BAND}")
    kind, initial, forces_n = loaded(tmp_path, text), STATES.copy(), FORCES_N.copy()
    simulation = kind.simulation(3)
    simulation.states = initial
    before = simulation.states
    simulation.step(forces_n)
    kind.in_band(initial)
    assert (simulation.states == STATES + 1).all() and (before == STATES).all()
    assert (initial == STATES).all() and (forces_n == FORCES_N).all()
