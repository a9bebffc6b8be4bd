"""Models whose embeddings, strides or names no datagram holds are refused, not exported."""

import json

import numpy as np
import pytest

from hjepa_cli.errors import DataError, UsageError
from hjepa_cli.storage import zoo
from hjepa_cli.wire import auth, export, protocol
from hjepa_cli.wire.bundle import MANIFEST, open_bundle, too_large
from hjepa_cli.wire.protocol import Embedding, Forces, Hello, Malformed

MANY = [
    ("plant_name", "a name that is far too long", r"1 to 16 ASCII characters"),
    ("action_shape", (17,), "strides of 4 steps of 17 forces; a datagram holds 64"),
    ("embedding", 2048, "embeddings of 2048 values; a datagram holds 1152"),
]


@pytest.mark.parametrize("plant", ["p", "p" * 16, "p" * 17, "two words", "ü", ""])
@pytest.mark.parametrize(
    ("embedding", "axes", "stride"),
    [(256, 1, 4), (1152, 1, 64), (1153, 1, 4), (256, 4, 16), (256, 5, 13), (1104, 13, 4)],
)
def test_what_is_too_large_is_what_the_other_side_does_not_read(plant, embedding, axes, stride):
    name = plant.encode()
    hello = Hello(1, bytes(8), 1, embedding, axes, protocol.INT8, bytes(32), plant)
    z, force_n = np.zeros(embedding, np.int8), np.zeros(axes, np.float32)
    packet = Embedding(1, 0, 0, force_n, 0, 0, 0, protocol.NO_STEP, 0, 1.0, z)
    forces = Forces(1, 1, 0, 0, np.zeros((stride, axes), np.float32))
    reads = True
    for body in (
        protocol.pack_hello(hello),
        protocol.pack_embedding(packet),
        protocol.pack_forces(forces),
    ):
        try:
            read = protocol.parse(auth.tagged(bytes(32), body))
            reads &= not isinstance(read, Hello) or read.plant.encode() == name
        except Malformed:
            reads = False
    assert (too_large(plant, embedding, axes, stride) is None) == reads


@pytest.mark.parametrize(("name", "value", "why"), MANY)
def test_manifests_of_what_no_datagram_holds_are_refused(name, value, why, tmp_path):
    manifest = dict(
        schema=1, plant_name="desktop", embedding=256, frames=4, action_shape=[], stride=4,
        force_limit_n=20.0, step_s=0.001, camera={}, networks={},
    ) | {name: value}  # fmt: skip
    manifest["plant"] = manifest.pop("plant_name")
    (tmp_path / MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(DataError, match=why):
        open_bundle(tmp_path)


def test_models_that_no_datagram_holds_are_refused_before_they_are_written(tmp_path, monkeypatch):
    path = zoo.resolve_model("desktop-h4m2l1")
    model = export.load_fp32(path)
    monkeypatch.setattr(export, "load_fp32", lambda path: model)
    for name, value, why in MANY:
        with monkeypatch.context() as changed, pytest.raises(UsageError, match=why):
            if name == "embedding":
                changed.setitem(model.architecture, name, value)
            else:
                changed.setattr(model, name, value)
            export.export(path, tmp_path / "new", None)
    assert not (tmp_path / "new").exists()
