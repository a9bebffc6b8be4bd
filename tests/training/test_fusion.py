"""``train-fusion``: its loops, its training, and models that have a posterior."""

import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import Shell, assert_one_line_error, open_shell
from test_reflex import QUIET, prepare
from test_reflex import settings as small

from hjepa_cli.config.schema import Settings
from hjepa_cli.core.control.drivers import methods_of, offered_methods
from hjepa_cli.core.networks.model import Model, build_modules, load_modules
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.training.fusion_loops import listen
from hjepa_cli.core.training.optimiser import Optimiser
from hjepa_cli.errors import Interrupted
from hjepa_cli.stages import resume, train_fusion, train_hierarchy, train_reflex
from hjepa_cli.storage.checkpoints import load_checkpoint

FUSION = {
    "fusion__rounds": 2,
    "fusion__devices": 2,
    "fusion__loop_steps": 30,
    "fusion__steps": 3,
    "fusion__batch": 4,
    "conditions__camera_noise": 8.0,
}


def settings(plant: str = "desktop") -> Settings:
    return small(plant, **FUSION)


def train(root: Path, out: Path, options: Settings) -> dict[str, Any]:
    inputs = {"dataset": root / "data", "checkpoint": str(root / "model.safetensors")}
    return train_fusion.run(options, QUIET, **inputs, out=out)


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.set_num_threads(1)
    root = tmp_path_factory.mktemp("fusion")
    prepare(root, settings())
    train(root, root / "run", settings())
    return root


@pytest.fixture
def shell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Shell:
    return open_shell(tmp_path, monkeypatch, capsys)


def test_loops_of_every_packet_can_be_planned(workplace: Path) -> None:
    """``run`` takes the only gap for a short one."""
    inputs = {"dataset": workplace / "data", "checkpoint": str(workplace / "model.safetensors")}
    often, usual = (
        train_fusion.plan(small(**FUSION, **gaps), **inputs).seconds
        for gaps in ({"protocol__gaps": (1,)}, {})
    )
    assert often > usual


def test_loops_tell_the_truth_beside_packets_in_noise(workplace: Path) -> None:
    """Half of the packets are exact; the truth of a packet is its own clean picture's."""
    checkpoint = load_checkpoint(workplace / "run" / "model.safetensors")
    posterior = load_modules(checkpoint)["posterior"]
    model = Model.load(checkpoint.path, "cpu")
    heard = listen(model, posterior, settings(), 0)
    assert heard.true.shape == heard.packets.shape == heard.predicted.shape
    apart = (heard.packets - heard.true).norm(dim=1).numpy()
    exact = apart < 1e-3
    assert 0.2 < exact.mean() < 0.8 and apart[~exact].min() > 0.01
    again = listen(model, posterior, settings(), 0)
    assert torch.equal(again.packets, heard.packets)
    other = listen(model, posterior, settings(), 1)
    assert len(other.true) != len(heard.true) or not torch.equal(other.true, heard.true)


def test_packets_and_truths_are_of_one_moment_whatever_the_link_is(workplace: Path) -> None:
    checkpoint = load_checkpoint(workplace / "run" / "model.safetensors")
    posterior = load_modules(checkpoint)["posterior"]
    model = Model.load(checkpoint.path, "cpu")
    late = {
        f"protocol__{key}": value
        for key, value in (("delay_steps", 3), ("jitter_steps", 2), ("downlink_loss", 0.3))
    }
    heard = listen(model, posterior, small("desktop", **FUSION, **late), 0)
    ideal = listen(model, posterior, settings(), 0)
    for name in ("predicted", "packets", "true"):
        assert torch.equal(getattr(heard, name), getattr(ideal, name)), name


def test_only_the_posterior_is_trained(workplace: Path) -> None:
    before = load_checkpoint(workplace / "model.safetensors").tensors
    after = load_checkpoint(workplace / "run" / "model.safetensors")
    for name, values in before.items():
        rounded = torch.from_numpy(values).bfloat16().float().numpy()
        kept = after.tensors[name]
        assert (kept == rounded).all() or (kept == values).all(), name  # weights, or statistics
    own = after.tensors.keys() - before.keys()
    assert own and all(name.startswith("posterior.") for name in own)
    assert any(np.abs(after.tensors[name]).max() > 0 for name in own if "output" in name)
    assert after.metadata["fusion"]["conditions"] == {"camera_noise": 8.0}
    model = Model.load(workplace / "run" / "model.safetensors", "cpu")
    assert "hjepa-fused" in methods_of(model) and "hjepa" in methods_of(model)
    assert "hjepa-fused" not in methods_of(Model.load(workplace / "model.safetensors", "cpu"))


@pytest.mark.parametrize("stage", [train_hierarchy, train_reflex])
def test_what_is_trained_on_a_fused_model_is_not_fused(workplace: Path, stage: Any) -> None:
    fused = load_checkpoint(workplace / "run" / "model.safetensors").metadata["architecture"]
    built = stage.describe_architecture(settings(), fused)
    assert "posterior" in build_modules(fused) and "posterior" not in build_modules(built)
    for architecture in (built, built | {"kind": "reflex", "fusion": True}):  # and what was saved
        assert "hjepa-fused" not in offered_methods(architecture, plant("desktop"))


@pytest.mark.parametrize("stop", [2, 5])  # in the first round and in the second
def test_an_interrupted_run_ends_in_the_same_bytes(
    workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: int
) -> None:
    update, seen = Optimiser.step, 0

    def step(self: Optimiser, *rest: Any) -> float:
        nonlocal seen
        seen += 1
        if seen == stop:
            os.kill(os.getpid(), signal.SIGINT)
        return update(self, *rest)

    with monkeypatch.context() as patched, pytest.raises(Interrupted):
        patched.setattr(Optimiser, "step", step)
        train(workplace, tmp_path / "run", settings())
    resume.run(tmp_path / "run", QUIET)
    for name in ("model.safetensors", "metrics.csv"):
        expected = (workplace / "run" / name).read_bytes()
        assert (tmp_path / "run" / name).read_bytes() == expected, name


def test_two_forces_and_six_states_train(tmp_path: Path) -> None:
    options = settings("quadrotor")
    prepare(tmp_path, options)
    found = train(tmp_path, tmp_path / "run", options)["distances"]
    assert found.keys() == {"predicted", "packets", "corrected"}


def test_a_model_without_a_posterior_names_the_command(shell: Shell, workplace: Path) -> None:
    model = str(workplace / "model.safetensors")
    refused = shell("eval", "--methods", "hjepa-fused", "--checkpoint", model)
    assert_one_line_error(refused, 66, "hjepa-fused", "train-fusion")
