"""A codec, a closed-form method and a trained predictor from one file each, outside the package."""

import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from command_line import block
from test_evaluate import Output, elsewhere, quick_encoder, small, untrained
from test_model_set import of_method, saved

from hjepa_cli import plugins
from hjepa_cli.api import predict
from hjepa_cli.compute.executors import placed
from hjepa_cli.config.checks import check_methods, check_payload
from hjepa_cli.config.schema import Settings
from hjepa_cli.core.control.drivers import build_driver, coder_of, methods_of, planner_of
from hjepa_cli.core.evaluation import curves
from hjepa_cli.core.evaluation.bench import Bench
from hjepa_cli.core.evaluation.curves import Digest
from hjepa_cli.core.networks.model import Model
from hjepa_cli.errors import ArrayError, DataError, UsageError
from hjepa_cli.stages import evaluate, scale
from hjepa_cli.stages.scale_by_formula import ByFormula
from hjepa_cli.wire.export import exported_method

__all__ = ["elsewhere", "quick_encoder"]  # fixtures

CODEC = block("plugins.md", "Codec(")

CLOSED_FORM = block("plugins.md", "least-squares")

PREDICTOR = block("plugins.md", "linear-step")


@pytest.fixture(autouse=True)
def no_plugins(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Whatever a test loads is gone after it."""
    for registry in (plugins.PLANTS, plugins.CODECS, plugins.METHODS):
        monkeypatch.setattr(registry, "_added", {})
    monkeypatch.setattr(plugins, "_sources", [])
    before = set(sys.modules)
    yield
    for name in [name for name in set(sys.modules) - before if name.startswith("hjepa_plugin")]:
        del sys.modules[name]


def loaded(directory: Path, text: str, name: str = "mine.py") -> ModuleType:
    """Write a plugin's file, load it as ``--plugin`` does, and return its module."""
    directory.mkdir(exist_ok=True)
    (directory / name).write_text(text)
    source = plugins.load_file(directory / name)
    return sys.modules[f"hjepa_plugin_{Path(name).stem}_{source.sha256[:8]}"]


def tiny(methods: tuple[str, ...], **protocol: Any) -> Settings:
    settings = small(methods=methods, **{"steps": 6, "horizon": 6} | protocol)
    radio = dataclasses.replace(settings.radio, snr_db="20:30:10", law="duty")
    collect = dataclasses.replace(settings.collect, trajectories=4, test_trajectories=2, steps=12)
    return dataclasses.replace(settings, radio=radio, collect=collect)


def run_both(settings: Settings, checkpoint: Path) -> dict[str, Any]:
    """``eval``, then ``scale`` on its curves; returns the entries of ``eval``."""
    measured = evaluate.run(settings, Output().screen, checkpoint=str(checkpoint))
    counted = scale.run(settings, Output().screen, checkpoint=str(checkpoint))
    assert {row["method"] for row in counted["rows"]} == set(settings.methods)
    assert all(row["devices"] is not None or row["reason"] for row in counted["rows"])
    entries: dict[str, Any] = measured["methods"]
    assert all(np.isfinite(entry["nmae"]).all() for entry in entries.values())
    return entries


def test_a_codec(tmp_path: Path, quick_encoder: None) -> None:
    checkpoint = untrained(tmp_path / "model.safetensors")
    with pytest.raises(UsageError, match=r"unknown payload 'signs'; choose float32, .*pca-8x6$"):
        check_payload("signs")
    loaded(tmp_path, CODEC)
    with pytest.raises(UsageError, match=r"like pca-8x6, or signs$"):
        check_payload("sign")
    entries = run_both(tiny(("hold", "hold-true"), payload="signs"), checkpoint)
    assert {entry["bits_per_transmission"] for entry in entries.values()} == {256}


def test_a_closed_form_method(tmp_path: Path, quick_encoder: None) -> None:
    checkpoint = untrained(tmp_path / "model.safetensors")
    loaded(tmp_path, CLOSED_FORM)
    check_methods(("least-squares",))
    entries = run_both(tiny(("least-squares", "hold")), checkpoint)
    assert entries["least-squares"]["bits_per_transmission"] == 2064
    assert entries["least-squares"]["nmae"] != entries["hold"]["nmae"]


def test_a_trained_predictor(tmp_path: Path, quick_encoder: None) -> None:
    base = untrained(tmp_path / "base" / "model.safetensors")
    settings, own = tiny(("linear-step",)), tmp_path / "own" / "model.safetensors"
    own.parent.mkdir()
    plugin = loaded(tmp_path, PREDICTOR)
    losses = plugin.train(base, own, settings)
    assert losses[-1] < losses[0]
    model = Model.load(own, "cpu")
    assert methods_of(model) == ("linear-step",) and planner_of(model, "linear-step").stride == 1
    assert "linear-step" not in methods_of(Model.load(base, "cpu"))
    run_both(settings, own)
    skipped = evaluate.run(tiny(("hold", "linear-step")), Output().screen, checkpoint=str(base))
    assert "linear_step.train" in skipped["skipped"]["linear-step"]
    # Without its plugin the file is data that nothing here can build.
    plugins.METHODS._added.clear()
    with pytest.raises(
        DataError, match="no method builds networks of kind 'linear-step'"
    ) as caught:
        Model.load(own, "cpu")
    assert "--plugin" in str(caught.value.hint)


@pytest.mark.slow
def test_worker_processes_have_the_plugins(tmp_path: Path) -> None:
    base = untrained(tmp_path / "base" / "model.safetensors")
    settings, own = tiny(("linear-step",), payload="signs"), tmp_path / "own" / "m.safetensors"
    own.parent.mkdir()
    loaded(tmp_path, CODEC, "codec.py")
    loaded(tmp_path, PREDICTOR).train(base, own, settings)
    here = evaluate.run(settings, Output().screen, checkpoint=str(own))
    with placed(workers=1):
        there = evaluate.run(settings, Output().screen, checkpoint=str(own), remeasure=True)
    assert there["methods"] == here["methods"]


def test_curves_expire_with_the_plugin_that_they_were_measured_with(
    tmp_path: Path, quick_encoder: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint = untrained(tmp_path / "model.safetensors")
    loaded(tmp_path, CLOSED_FORM)
    settings = tiny(("least-squares", "hold"))
    evaluate.run(settings, Output().screen, checkpoint=str(checkpoint))
    digest = Digest.of(Model.load(checkpoint).digest, settings)
    [kept] = (tmp_path / "runs" / "eval").glob("*/curves.json")
    assert set(curves.read(kept, digest)) == {"least-squares", "hold"}
    loaded(tmp_path, CLOSED_FORM + "# changed\n")  # takes the place of what it was
    assert set(curves.read(kept, digest)) == {"hold"}
    measured = []
    entry = Bench.entry
    monkeypatch.setattr(
        Bench, "entry", lambda self, method: measured.append(method.name) or entry(self, method)
    )
    evaluate.run(settings, Output().screen, checkpoint=str(checkpoint))
    assert measured == ["least-squares"]


def test_curves_expire_with_a_codec(tmp_path: Path) -> None:
    built_in = Digest.of("model", tiny(("hold",)))
    loaded(tmp_path, CODEC)
    assert Digest.of("model", tiny(("hold",))) == built_in
    first = Digest.of("model", tiny(("hold",), payload="signs"))
    loaded(tmp_path, CODEC + "# changed\n")
    assert Digest.of("model", tiny(("hold",), payload="signs")).protocol != first.protocol


ANSWERS = """
import dataclasses
import functools
from hjepa_cli import register
from hjepa_cli.core.control.controllers import LastForce
from hjepa_cli.core.control.drivers import embedding_driver
from hjepa_cli.core.control.methods.method import Method
from hjepa_cli.core.control.methods.predictors import predictor

class Planner:
    stride = 2
    def __init__(self, model): pass
    def plan(self, z): return PLAN
    def follow(self, z, forces_n, ages): return z[:1]

class Controller:
    def __init__(self, devices): pass
    def act(self, delivered, packets): return ACT
    def planned_n(self): return TOLD
    def ahead_n(self): return TOLD

def build(settings, model):
    made = {"last": functools.partial(LastForce, lambda z: ACT), "own": Controller}.get(KIND, id)
    driver = embedding_driver("mine", settings, model, made, family="mine")
    changed = {"bits": {"bits_per_transmission": -7}, "none": {"controller": None}}.get(KIND, {})
    return dataclasses.replace(driver, **changed) if KIND else 7

def any(architecture, plant): return True

register(predictor("mine", Planner, offered=any) if KIND == "planner"
         else Method("mine", "embedding", build, offered=any))
"""


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return untrained(tmp_path_factory.mktemp("model") / "model.safetensors")


@pytest.mark.parametrize(
    ("kind", "answer", "says"),
    [
        ("last", "z[:, :1]", r"act\(…\) is \(4, 1\) of float32; expected numbers of shape \(4,\)$"),
        ("last", "z[:, :3]", r"act\(…\) is \(4, 3\)"),
        ("last", "z[:1, 0]", r"act\(…\) is \(1,\)"),
        ("last", "None", r"act\(…\) is \(\) of object"),
        ("last", "z[:, 0] + float('nan')", r"act\(…\)\[0\] is nan; expected finite numbers$"),
        ("own", "packets[:, :1]", r"act\(…\) is \(4, 1\)"),
        ("own", "packets[:1, 0]", r"act\(…\) is \(1,\)"),
        ("own", "packets[:, 0] / 0", r"act\(…\)\[0\] is (nan|-?inf)"),
        ("planner", "z[:, :1], z", r"plan\(…\) is \(4, 1\) of float32; .* shape \(4, 2\)$"),
        ("planner", "z[:, :2], z[:1]", r"embeddings of plan\(…\) is \(1, \d+\) .* \(4, \d+\)$"),
        ("planner", "z[:, :2].numpy(), z", r"plan\(…\) is a ndarray; expected a Tensor$"),
        ("planner", "None", "TypeError: cannot unpack"),
        ("number", "0", "'int' object has no attribute 'act'$"),
        ("bits", "0", "bits_per_transmission = -7; expected a whole number of at least 0$"),
        ("none", "0", "its driver's controller = None is no function$"),
        ("", "0", r"build\(…\) made 7; expected a Driver$"),
    ],
)
def test_a_method_that_answers_wrong_is_named(
    tmp_path: Path, checkpoint: Path, kind: str, answer: str, says: str
) -> None:
    text = ANSWERS.replace("KIND", repr(kind)).replace("PLAN", answer).replace("ACT", answer)
    loaded(tmp_path, text)
    model = Model.load(checkpoint, "cpu")
    z = torch.ones(4, model.architecture["embedding"])
    with pytest.raises(UsageError, match=rf"^plugin .*mine\.py: method 'mine': .*{says}") as caught:
        build_driver("mine", tiny(("mine",)), model).controller(4).act(np.ones(4, bool), z)
    assert caught.value.exit_code == 2


@pytest.mark.parametrize("answer", ["z[:, :1], z", "z[:, :2], z[:1]"])
def test_a_planner_that_answers_wrong_is_told_without_a_loop_too(
    tmp_path: Path, checkpoint: Path, answer: str
) -> None:
    loaded(tmp_path, ANSWERS.replace("KIND", "'planner'").replace("PLAN", answer))
    model = Model.load(checkpoint, "cpu")
    with pytest.raises(ArrayError, match=r"plan\(…\) is "):
        predict(model, torch.ones(4, model.architecture["embedding"]), 2, method="mine")


def test_a_planner_that_no_bundle_holds_is_not_exported(tmp_path: Path, checkpoint: Path) -> None:
    loaded(tmp_path, ANSWERS.replace("KIND", "'planner'").replace("PLAN", "z[:, :2], z"))
    model = Model.load(checkpoint, "cpu")
    assert "mine" in methods_of(model)
    with pytest.raises(UsageError, match="cannot be exported as 'mine'"):
        exported_method(model, "mine")


def test_what_else_a_plugin_s_controller_tells_names_it_too(
    tmp_path: Path, checkpoint: Path
) -> None:
    model = Model.load(checkpoint, "cpu")
    z = torch.zeros(4, model.architecture["embedding"])
    loaded(tmp_path, ANSWERS.replace("KIND", "'planner'").replace("PLAN", "z[:, :2], z"))
    controller = build_driver("mine", tiny(("mine",)), model).controller(4)
    assert controller.stride_steps == 2 and not controller.act(np.ones(4, bool), z).any()
    with pytest.raises(UsageError, match=r"mine.py: method 'mine': follow\(…\) is \(1, \d+\)"):
        controller.act(np.ones(4, bool), z, np.full(4, 2))


@pytest.mark.parametrize(
    ("told", "planned", "ahead"),
    [
        ("None", r"planned_n\(\) is \(\) of object", r"ahead_n\(\) is \(\) of object"),
        ("[0.0]", r"\(1,\) of float64; .* \(4,\)$", r"\(1,\) of float64; .* \(4, 16\)$"),
        ("torch.zeros(4, 9, 1)", r"\(4, 9, 1\) .* \(4,\)$", r"\(4, 9, 1\) .* \(4, 9\)$"),
        ("torch.zeros(4) / 0", r"planned_n\(\)\[0\] is nan", r"\(4,\) .* \(4, 16\)$"),
        ("torch.zeros(4, 9) / 0", r"\(4, 9\) .* \(4,\)$", r"ahead_n\(\)\[0, 0\] is nan"),
    ],
)
def test_forces_that_a_controller_tells_of_are_looked_at_too(
    tmp_path: Path, checkpoint: Path, told: str, planned: str, ahead: str
) -> None:
    loaded(tmp_path, "import torch" + ANSWERS.replace("KIND", "'own'").replace("TOLD", told))
    model = Model.load(checkpoint, "cpu")
    controller: Any = build_driver("mine", tiny(("mine",)), model).controller(4)
    for asked, says in ((controller.planned_n, planned), (controller.ahead_n, ahead)):
        with pytest.raises(UsageError, match=rf"^plugin .*mine\.py: method 'mine': .*{says}"):
            asked()


def test_what_a_method_says_of_its_models_names_it(tmp_path: Path, checkpoint: Path) -> None:
    text = ANSWERS.replace("def any(architecture, plant)", "def any(architecture)")
    loaded(tmp_path, text.replace("KIND", "'own'"))
    with pytest.raises(UsageError, match=r"mine\.py: method 'mine': TypeError: any\(\) takes 1"):
        methods_of(Model.load(checkpoint, "cpu"))


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("z.sign().float()", "z[:, :3]", r"send\(…\) is \(4, 3\) of float32; .* shape \(4, \d+\)$"),
        ("z.sign().float()", "z.numpy()", r"send\(…\) is a ndarray; expected a Tensor$"),
        ("z.sign().float()", "z.double()", r"send\(…\) is torch.float64; expected torch.float32$"),
        ("z.sign().float()", "z / 0", r"send\(…\)\[0, 0\] is nan; expected finite numbers$"),
        ("return Signs()", "return None", "'NoneType' object has no attribute 'send'$"),
        ("def fit(model, settings)", "def fit(model)", r"TypeError: fit\(\) takes 1"),
    ],
)
def test_a_codec_that_sends_wrong_is_named(
    tmp_path: Path, checkpoint: Path, old: str, new: str, says: str
) -> None:
    loaded(tmp_path, CODEC.replace(old, new))
    model = Model.load(checkpoint, "cpu")
    z = torch.zeros(4, model.architecture["embedding"])
    with pytest.raises(UsageError, match=rf"^plugin .*mine\.py: codec 'signs': .*{says}"):
        coder_of(tiny(("hold",), payload="signs"), model).send(z)


@pytest.mark.parametrize("count", ["-7", "0", "2.5", "None", "float('nan')"])
def test_a_codec_counts_whole_bits(tmp_path: Path, count: str) -> None:
    loaded(tmp_path, CODEC.replace("embedding: embedding", f"embedding: {count}"))
    says = r"mine.py: codec 'signs': bits\(256\) = .*; expected a whole number above 0"
    with pytest.raises(UsageError, match=says):
        plugins.CODECS["signs"].bits(256)


def test_methods_with_and_without_embeddings_are_charged_the_same(
    tmp_path: Path, checkpoint: Path
) -> None:
    """A coder that says something else of its bits is not asked."""
    loaded(tmp_path, CODEC.replace("    def send", "    bits = 1024\n\n    def send"))
    model, settings = Model.load(checkpoint, "cpu"), tiny(("hold", "oracle"), payload="signs")
    bits = {build_driver(name, settings, model).bits_per_transmission for name in settings.methods}
    assert bits == {model.architecture["embedding"]}


FRAMES = """
from hjepa_cli.core.control.drivers import Driver, last_force
from hjepa_cli.core.control.methods.method import Method
from hjepa_cli.core.control.sensors import camera_sensor
from hjepa_cli.core.plants.conditions import actual_camera
from hjepa_cli.plugins import register

def build(settings, model):
    sensor, drives = camera_sensor(model, actual_camera(settings)), last_force(model)
    return Driver("my-frames", sensor, drives, drives, 5 * 32 * 64, "my-frames")

register(Method("my-frames", "frames", build, offered=lambda architecture, plant: True))
"""


def test_frames_are_as_late_as_their_driver_s_bits_take(tmp_path: Path) -> None:
    """Of whatever name the method is, and whatever the size of the model's pictures."""
    loaded(tmp_path, FRAMES)
    camera = {"camera.height_px": 32, "camera.width_px": 64, "camera.grey": True}
    trained = of_method("supervised", **camera)
    checkpoint = saved(tmp_path / "model.safetensors", trained)
    settings = tiny(("supervised-2", "my-frames"))
    radio = dataclasses.replace(settings.radio, bandwidth_hz=1e6)
    settings = dataclasses.replace(settings, radio=radio)
    counting = ByFormula(
        plugins.LAWS["duty"], settings, Output().screen, checkpoint=str(checkpoint)
    )
    per_slot = 1e3 * np.log2(101)
    slots = {
        name: int(np.ceil(bits * 32 * 64 / per_slot))
        for name, bits in (("supervised-2", 2 * 8), ("my-frames", 5))
    }
    assert counting.measured_methods([20.0]) == {
        20.0: [f"{name}+{late}" for name, late in slots.items()]
    }


FAMILY = """
import re
from hjepa_cli.core.control.codecs.codec import Codec, CodecFamily
from hjepa_cli.plugins import register

def member(name):
    found = re.fullmatch("keep-([0-9]+)", name)
    return found and Codec(name, bits=lambda embedding: int(found[1]), fit=print)

register(CodecFamily("keep-N", member, "keep-N for the first N values"))
"""


def test_a_family_s_members_come_from_their_names(tmp_path: Path) -> None:
    loaded(tmp_path, FAMILY)
    assert plugins.CODECS["keep-12"].bits(256) == 12 and "keep-N" not in plugins.CODECS
    assert plugins.CODECS.source("keep-12") == plugins.in_force()[-1]
    assert plugins.CODECS.source("int8") is None
    with pytest.raises(UsageError, match=r"keep-N for the first N values$"):
        check_payload("keep-")
    taken = FAMILY.replace("keep-N", "pca-4x4")
    with pytest.raises(UsageError, match="there is a codec called 'pca-4x4' already"):
        loaded(tmp_path, taken, "other.py")
