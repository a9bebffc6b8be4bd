"""The search of control laws: its simulation against the loop, and what it finds."""

import dataclasses
import tomllib
from pathlib import Path

import numpy as np
import pytest
from command_line import Shell, assert_one_line_error, open_shell

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.controllers import Oracle
from hjepa_cli.core.control.loop import simulate
from hjepa_cli.core.control.sensors import true_state
from hjepa_cli.core.plants.control_law import LinearLaw
from hjepa_cli.core.plants.linear import gains_at_rest
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.statistics import ratio
from hjepa_cli.core.training.law_search import LawSearch

SMALL = {"tune.devices": 3, "tune.steps": 150, "protocol.warmup_steps": 30}


@pytest.fixture
def hjepa(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Shell:
    return open_shell(tmp_path, monkeypatch, capsys)


@pytest.mark.parametrize("name", ["desktop", "quadrotor"])
def test_candidates_are_driven_as_the_oracle_drives(name: str) -> None:
    """Without errors; pymunk and the exact equations differ in the last bits, so a step may."""
    options = load_settings(flags=SMALL | {"plant": name, "tune.packet_error": 0.0})
    kind = plant(name)
    search = LawSearch.make(kind, options.protocol, options.tune, seed=0)
    own_n = gains_at_rest(kind.teacher(), len(kind.state_names))
    both = np.stack([own_n, 2 * own_n])
    found, _ = search.drive(both)
    loops = 3 * len(search.trial.gaps)
    for row, gains_n in zip(found, both, strict=True):
        law = LinearLaw(gains_n, kind.force_limit_n, kind.action_shape)
        oracle = Oracle(
            law,
            kind.advance,
            kind.force_limit_n,
            loops,
            states=len(kind.state_names),
            action_shape=kind.action_shape,
        )
        outcome = simulate(kind, search.trial.draws, search.trial.schedules, oracle, true_state)
        np.testing.assert_allclose(row, ratio(outcome.score, search.trial.teacher), atol=0.02)


def test_a_price_on_forces_finds_a_softer_law() -> None:
    options = load_settings("gym", flags={"tune.devices": 8, "tune.steps": 300, "tune.rounds": 8})
    search = LawSearch.make(plant("gym"), options.protocol, options.tune, seed=0)
    soft, stiff = (search.gains_n(learnable=learnable) for learnable in (True, False))
    _, forces_n = search.drive(np.stack([soft, stiff]))
    assert forces_n[0].mean() < 0.9 * forces_n[1].mean()


def test_a_tuned_law_tolerates_more_than_the_teacher() -> None:
    """On other draws than the search's."""
    options = load_settings("gym", flags={"tune.devices": 8, "tune.steps": 300, "tune.rounds": 8})
    kind = plant("gym")
    found = LawSearch.make(kind, options.protocol, options.tune, seed=0).gains_n(learnable=True)
    other = dataclasses.replace(options.tune, devices=32)
    test = LawSearch.make(kind, options.protocol, other, seed=5)
    own_n = gains_at_rest(kind.teacher(), 4)
    (tuned, own), _ = test.drive(np.stack([found, own_n]))
    assert tuned.mean() > own.mean() + 0.02


def test_the_command_writes_settings_for_the_next_one(hjepa: Shell) -> None:
    Path("c.toml").write_text(
        "[tune]\ndevices = 2\nsteps = 40\nrounds = 1\n[protocol]\nwarmup_steps = 10\nsteps = 400\n"
    )
    plan = hjepa("tune-law", "--config", "c.toml", "--dry-run")
    assert plan.code == 0 and "search 2 laws of plant desktop" in plan.out
    result = hjepa("tune-law", "--config", "c.toml", "--json").document
    written = tomllib.loads(Path(result["law"]).read_text())
    assert written["control"]["gains_n"] == np.ravel(result["gains_n"]).tolist()
    options = load_settings(config=result["law"])
    assert options.plant == "desktop" and len(options.control.ceiling_gains_n) == 4
    again = hjepa("tune-law", "--config", "c.toml", "--json", "--out", "once more")
    assert again.document["gains_n"] == result["gains_n"]
    assert "next: hjepa collect --config 'once more/law.toml'" in again.err


@pytest.mark.parametrize("link", ["delay_steps = 15", "jitter_steps = 2", "downlink_loss = 0.1"])
def test_no_law_is_tuned_for_a_late_link(hjepa: Shell, link: str) -> None:
    """The search has packets arrive at once: gaps that were found otherwise are not its own."""
    Path("c.toml").write_text(f"[protocol]\n{link}\n")
    for dry in ((), ("--dry-run",)):
        outcome = hjepa("tune-law", "--config", "c.toml", "--quiet", *dry)
        assert_one_line_error(outcome, 2, "arrive at once", "delay_steps, jitter_steps")
    assert not Path("runs").exists()


def test_a_search_that_found_no_law_leaves_what_it_found(
    hjepa: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Minutes of work; the same command would find the same."""
    own = {True: gains_at_rest(plant("desktop").teacher(), 4).round(3), False: np.zeros((1, 4))}
    monkeypatch.setattr(LawSearch, "gains_n", lambda self, *, learnable: own[learnable])
    Path("c.toml").write_text("[tune]\ndevices = 2\nsteps = 40\n[protocol]\nwarmup_steps = 10\n")
    outcome = hjepa("tune-law", "--config", "c.toml", "--out", "r", "--seed", "4", "--quiet")
    says = ("control.ceiling_gains_n", "does not hold plant desktop", "more [tune] rounds than 24")
    assert_one_line_error(outcome, 70, *says, "--seed 5")
    written = tomllib.loads(Path("r/law.toml").read_text())["control"]
    assert written == {"gains_n": own[True][0].tolist(), "ceiling_gains_n": [0.0] * 4}
    assert not Path("r/result.json").exists()
