"""What is exported computes what torch computes, and is refused once a byte of it changes."""

import json
import shutil

import numpy as np
import pytest
import torch

from hjepa_cli.errors import DataError, MissingInputError, NumericalError, UsageError
from hjepa_cli.wire.bundle import MANIFEST, open_bundle

pytest.importorskip("onnxruntime")
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def copy(exported, tmp_path_factory):
    def make():
        target = tmp_path_factory.mktemp("copy") / "model"
        return shutil.copytree(exported, target)

    return make


def test_the_check_measures_what_the_issue_asks(exported, checkpoint):
    from hjepa_cli.wire import export

    measured = export.check(open_bundle(exported), checkpoint)
    assert max(measured["max_error"].values()) <= 1e-5
    assert measured["int8"]["rms_z"] <= 0.015 and measured["int8"]["force_share"] <= 0.035
    assert json.loads((exported / "check.json").read_text())["n"] == measured["n"]


def test_the_check_finds_another_network(copy, checkpoint):
    """The actor's sign is turned, its digest made good: the numbers alone tell."""
    import hashlib

    import onnx
    from onnx import numpy_helper

    from hjepa_cli.wire import export

    directory = copy()
    model = onnx.load(directory / "actor.onnx")
    last = max(
        (one for one in model.graph.initializer if len(one.dims) == 2), key=lambda one: one.dims[1]
    )
    last.CopyFrom(numpy_helper.from_array(-numpy_helper.to_array(last), last.name))
    data = model.SerializeToString()
    (directory / "actor.onnx").write_bytes(data)
    manifest = json.loads((directory / MANIFEST).read_text())
    manifest["networks"]["actor"]["files"]["actor.onnx"] = hashlib.sha256(data).hexdigest()
    (directory / MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(NumericalError, match="force"):
        export.check(open_bundle(directory), checkpoint)


@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
def test_any_batch_gives_every_row_its_own_result(exported, backend):
    pytest.importorskip(backend)
    from hjepa_cli.wire.runtime import Runtime

    runtime = Runtime(open_bundle(exported), backend)
    z = np.random.default_rng(0).normal(size=(70, 256)).astype(np.float32)
    z *= 16 / np.linalg.norm(z, axis=1, keepdims=True)
    forces_n, z_next = runtime.plan(z)
    assert forces_n.shape == (70, 4, 1) and z_next.shape == (70, 256)
    for rows in (1, 2, 5, 17):
        few_n, few = runtime.plan(z[:rows])
        np.testing.assert_allclose(few_n, forces_n[:rows], atol=1e-5)
        np.testing.assert_allclose(few, z_next[:rows], atol=1e-5)


def test_no_batch_is_compiled_while_devices_wait(exported, monkeypatch):
    """A compilation takes as long as many control steps: all are made before the first one."""
    openvino = pytest.importorskip("openvino")
    from hjepa_cli.wire.runtime import Runtime

    runtime = Runtime(open_bundle(exported), "openvino")
    runtime.warm_up("actor")
    monkeypatch.setattr(openvino.Core, "compile_model", None)
    for rows in (1, 3, 16, 64):
        assert len(runtime.act(np.zeros((rows, 256), np.float32))) == rows


def test_follow_is_that_of_the_simulator(exported, checkpoint):
    """Against :func:`planners.follow` in torch, ages of all kinds, 0 and rests of strides too."""
    from hjepa_cli.core.control.planners import Hierarchy
    from hjepa_cli.wire.export import load_fp32
    from hjepa_cli.wire.runtime import Runtime

    random = np.random.default_rng(1)
    z = random.normal(size=(12, 256)).astype(np.float32)
    z *= 16 / np.linalg.norm(z, axis=1, keepdims=True)
    ages = np.arange(12)
    forces_n = random.uniform(-20, 20, (12, 11, 1)).astype(np.float32)
    planner = Hierarchy(load_fp32(checkpoint))
    with torch.inference_mode():
        expected = planner.follow(torch.from_numpy(z), torch.from_numpy(forces_n[..., 0]), ages)
    found = Runtime(open_bundle(exported)).follow(z, forces_n, ages)
    np.testing.assert_allclose(found, expected.numpy(), atol=1e-5)
    np.testing.assert_array_equal(found[0], z[0])


@pytest.mark.parametrize("file", ["planner.onnx", "planner.bin"])
def test_a_changed_byte_is_refused(copy, file):
    from hjepa_cli.wire.runtime import Runtime

    directory = copy()
    data = bytearray((directory / file).read_bytes())
    data[len(data) // 2] ^= 1
    (directory / file).write_bytes(bytes(data))
    with pytest.raises(DataError, match=file):
        Runtime(open_bundle(directory)).warm_up("planner")


@pytest.mark.parametrize(
    "change",
    [
        {"plant": 3}, {"embedding": 0}, {"stride": "4"},
        {"force_limit_n": -1}, {"networks": {"encoder": {"files": {"../../etc/passwd": ""}}}},
        {"networks": {"shell": {"files": {"shell.onnx": "", "shell.bin": ""}}}},
        {"camera": None}, {"action_shape": [0]},
    ],
)  # fmt: skip
def test_manifests_that_say_nonsense_are_refused(copy, change):
    directory = copy()
    manifest = json.loads((directory / MANIFEST).read_text())
    (directory / MANIFEST).write_text(json.dumps(manifest | change))
    with pytest.raises(DataError, match="malformed"):
        open_bundle(directory)


def test_there_must_be_a_whole_manifest_of_this_version(copy, tmp_path):
    with pytest.raises(MissingInputError, match="no exported model"):
        open_bundle(tmp_path)
    directory = copy()
    (directory / MANIFEST).write_text('{"schema": 99}')
    with pytest.raises(DataError, match="schema 99"):
        open_bundle(directory)
    (directory / MANIFEST).write_text("{")
    with pytest.raises(DataError, match="not valid JSON"):
        open_bundle(directory)


def test_models_that_plan_nothing_and_other_directories_are_refused(tmp_path):
    from hjepa_cli.storage import zoo
    from hjepa_cli.wire.export import export

    with pytest.raises(UsageError, match="plans no strides"):
        export(zoo.resolve_model("desktop-reflex"), tmp_path / "new", None)
    with pytest.raises(UsageError, match="choose from hjepa"):
        export(zoo.resolve_model("desktop-h4m2l1"), tmp_path / "new", "oracle")
    (tmp_path / "letter.txt").write_text("mine")
    with pytest.raises(UsageError, match=r"letter\.txt"):
        export(zoo.resolve_model("desktop-h4m2l1"), tmp_path, None)


def test_a_refusal_does_not_begin_with_how_long_it_takes(tmp_path, monkeypatch, capsys):
    from command_line import assert_one_line_error, open_shell

    shell = open_shell(tmp_path, monkeypatch, capsys)
    outcome = shell("export", "desktop-reflex", "--to", "new")
    assert_one_line_error(outcome, 2, "plans no strides")
    assert "exporting" not in outcome.err and not list(tmp_path.iterdir())


def test_a_model_that_corrects_by_packets_is_exported_without_that():
    """A bundle has no posterior: as ``hjepa-fused`` it would drive as another method."""
    from hjepa_cli.core.control import drivers
    from hjepa_cli.storage import zoo
    from hjepa_cli.wire import export

    model = export.load_fp32(zoo.resolve_model("desktop-h4m2l1"))
    model.architecture["fusion"] = True
    assert "hjepa-fused" in drivers.methods_of(model)
    assert export.exported_method(model, None) == "hjepa"
    with pytest.raises(UsageError, match="cannot be exported as 'hjepa-fused'"):
        export.exported_method(model, "hjepa-fused")


def test_models_of_other_pictures_are_refused(tmp_path):
    """Cameras, doors and calibration of the wire know pictures of one size, and plants to draw."""
    import dataclasses
    from pathlib import Path

    from hjepa_cli.config.schema import CameraSettings
    from hjepa_cli.core.plants.recorded import UNKNOWN
    from hjepa_cli.storage import zoo
    from hjepa_cli.wire import export

    small = dataclasses.asdict(CameraSettings(height_px=32, width_px=64))
    for change in ({"architecture": {"camera": small}}, {"plant": UNKNOWN}):
        model = export.load_fp32(zoo.resolve_model("desktop-h4m2l1"))
        for name, value in change.items():
            old = getattr(model, name)
            setattr(model, name, old | value if isinstance(value, dict) else value)
        with pytest.raises(UsageError, match=r"devices take those|learned from recordings"):
            export.check_pictures(model, Path("m.safetensors"))


@pytest.fixture(scope="module")
def apart(checkpoint, tmp_path_factory):
    """The zoo's networks with pictures three steps apart; exported."""
    from hjepa_cli.core.networks.model import load_modules, tensors_of
    from hjepa_cli.storage import files
    from hjepa_cli.storage.checkpoints import load_checkpoint, save_checkpoint
    from hjepa_cli.wire.export import export

    shipped, directory = load_checkpoint(checkpoint), tmp_path_factory.mktemp("apart")
    metadata, modules = files.jsonable(shipped.metadata), load_modules(shipped)
    for told in (metadata["architecture"], metadata["settings"]["encoder"]):
        told |= {"frames": 4, "frame_gap": 1, "frame_spacing": "square"}
    modules["encoder"].input_std[3:] *= 3  # things move three times as far
    save_checkpoint(directory / "model.safetensors", tensors_of(modules), metadata)
    return export(directory / "model.safetensors", directory / "out", None)


def test_pictures_apart_and_fitted_to_their_background_are_exported(apart, monkeypatch):
    from hjepa_cli.wire import export

    # Networks that were not trained for it lose a little more in 8 bits.
    monkeypatch.setitem(export.LARGEST_INT8, "force_share", 0.05)
    assert apart.look == (9, 4, 1, 0) and open_bundle(apart.directory).look == apart.look
    measured = export.check(apart, apart.directory.parent / "model.safetensors")
    assert max(measured["max_error"].values()) <= 1e-5
    manifest = json.loads((apart.directory / MANIFEST).read_text())
    # A device remembers 16 pictures.
    told = [{"frame_gap": gap} for gap in (0, 2, 1.0, "3")] + [{"frame_spacing": "odd"}]
    for number, other in enumerate(told):
        changed = apart.directory.parent / f"changed-{number}"
        changed.mkdir()
        (changed / MANIFEST).write_text(json.dumps(manifest | other))
        with pytest.raises(DataError, match="malformed"):
            open_bundle(changed)


@pytest.mark.parametrize("which", ["exported", "apart"])
def test_lockstep_is_the_simulator(which, request):
    """Two loops with the same networks: over the wire and in the simulator, lost downlinks too.

    Forces travel as float32, which the simulator's planner makes them too: states are equal but
    for rounding, until a grey level rounds to another side.
    """
    import dataclasses

    from hjepa_cli.config.schema import ProtocolSettings
    from hjepa_cli.core.control.loop import Draws, gap_schedule
    from hjepa_cli.core.plants.named import plant
    from hjepa_cli.stages.bench_link import Exported, simulated
    from hjepa_cli.wire.auth import NO_KEY
    from hjepa_cli.wire.bench import Fleet, lockstep
    from hjepa_cli.wire.controller import Controller
    from hjepa_cli.wire.runtime import Runtime

    made = request.getfixturevalue(which)
    bundle = made if which == "apart" else open_bundle(made)
    kind, devices, steps = plant("desktop"), 4, 120
    runtime = Runtime(bundle)
    protocol = dataclasses.replace(ProtocolSettings(), warmup_steps=0, steps=steps)
    draws, sent = Draws.make(protocol, devices, 3), gap_schedule(30, steps, devices)
    camera = kind.camera()
    fleet = Fleet(bundle, runtime, kind, camera, draws, sent, NO_KEY, 0.005)
    wired = lockstep(fleet, Controller(bundle, runtime, NO_KEY), draws.link)
    states = np.empty_like(wired.states)
    planner = Exported(runtime, ())
    score = simulated(runtime, planner, kind, camera, draws, sent, states, lambda: None)
    assert wired.missing == 0 and wired.late_answers == 0
    np.testing.assert_allclose(wired.states[..., 2], states[..., 2], atol=1e-6)
    np.testing.assert_allclose(wired.score, score, atol=0.02)
