"""Numbers that must not move by accident. If one of these tests fails because you meant to change
what the loop computes, raise ``LOOP_VERSION`` in core/control/loop.py, measure the zoo's curves
again, and write down the new numbers here: cached curves of the old loop then expire."""

import numpy as np
import pytest
import torch

from hjepa_cli.config.schema import Settings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.drivers import build_driver
from hjepa_cli.core.control.loop import LOOP_VERSION
from hjepa_cli.core.datasets.trajectories import generate
from hjepa_cli.core.evaluation.control_errors import control_errors
from hjepa_cli.core.evaluation.protocol import Point
from hjepa_cli.core.evaluation.simulator import Block, Simulator
from hjepa_cli.core.networks.model import Model, build_modules
from hjepa_cli.core.plants.named import plant
from hjepa_cli.stages.train_encoder import describe_architecture

POINTS = (Point("gap", 45.0), Point("delivery", 30.0))
STEPS, DEVICES = 300, 8

# Scores of both points, then their costs.
OUTCOMES = {
    "hold-true": [0.69291667, 0.65375, 3.28793347, 3.8198504],
    "zero-true": [0.43583333, 0.43958333, 0.54154553, 0.59032168],
    "oracle": [0.82875, 0.80791667, 0.0791869544, 0.080356633],
}
# Control error 0, 1, 3, 6 and 12 steps after the packet.
PLAYED = {
    "hjepa": [0.24774, 0.2415, 0.21891, 0.17864, 0.13645],
    "ts-jepa-1": [0.24774, 0.2475, 0.22691, 0.19219, 0.13857],
    "ts-jepa-4": [0.24774, 0.24127, 0.22345, 0.1906, 0.13753],
    "hold": [0.24774, 0.24127, 0.22345, 0.19682, 0.15102],
}


def settings() -> Settings:
    flags = {
        "protocol": "paper",
        "protocol.steps": STEPS,
        "protocol.bracket_devices": DEVICES,
        "protocol.curve_devices": DEVICES,
        "encoder.precision": "fp32",
        "encoder.hidden": 32,
        "encoder.frames": 2,
        "encoder.photometric": "none",
        "control.gains_n": [],
    }
    return load_settings(flags=flags)


def untrained() -> Model:
    """Random networks of a fixed seed: as good as trained ones for keeping numbers still."""
    architecture = describe_architecture(settings()) | {
        "kind": "hierarchy",
        "h": 4,
        "m": 2,
        "l": 1,
        "actor_hidden": 32,
        "actor_dropout": 0.0,
    }
    torch.manual_seed(0)
    modules = build_modules(architecture)
    for name in ("high", "medium", "low", "flat"):  # they start as "nothing changes"
        for parameter in modules[name].output.parameters():
            torch.nn.init.normal_(parameter, std=0.2)
    for parameter in modules["actor"].layers[-1].parameters():
        torch.nn.init.normal_(parameter, std=1.0)
    metadata = {"architecture": architecture, "plant": "desktop", "settings": settings().as_dict()}
    return Model(modules, metadata, "", "cpu")


@pytest.mark.parametrize("name", OUTCOMES)
def test_the_loop_on_true_states(name: str) -> None:
    outcome = Block(name, POINTS, 0, DEVICES).compute(
        Simulator(settings(), None), lambda steps: None
    )
    measured = np.concatenate([outcome.score.mean(axis=1), outcome.cost.mean(axis=1)])
    assert measured == pytest.approx(OUTCOMES[name], rel=1e-6)
    assert LOOP_VERSION == 6


@pytest.mark.parametrize("name", PLAYED)
def test_what_controllers_play_after_one_packet(name: str) -> None:
    """Camera, encoder, quantisation, planner and actor in one number per step, in float32."""
    options = settings()
    clean = generate(options, "clean")
    errors = control_errors(
        build_driver(name, options, untrained()),
        clean.states[:6].astype(float),
        clean.teacher_n[:6].astype(float),
        plant("desktop").force_limit_n,
        12,
    )
    assert errors.mean(axis=0)[[0, 1, 3, 6, 12]] == pytest.approx(PLAYED[name], abs=2e-4)
    assert LOOP_VERSION == 6
