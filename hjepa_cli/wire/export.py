"""A trained model becomes a bundle: its networks as ONNX, in fp32, the encoder in int8 too.

A stride of the planner is one network, so that a controller makes one call for it. Batches may be
of any size. In the int8 encoder the last stage and the layer behind it, two thirds of the weights,
multiply integers. Stem, first stages, head and all sums stay float: they carry the few grey levels
that are the velocity (docs/LOG.md has what their rounding costs).
"""

import contextlib
import copy
import hashlib
import logging
import math
import os
import tempfile
import warnings
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from torch import Tensor, nn

from hjepa_cli import __version__
from hjepa_cli.config.schema import LOOK, CollectSettings, Settings
from hjepa_cli.core.arrays import Pixels
from hjepa_cli.core.control.drivers import methods_of, planner_of
from hjepa_cli.core.control.planners import Hierarchy, OnePredictor
from hjepa_cli.core.control.spoilt import most_changed
from hjepa_cli.core.datasets.trajectories import generate
from hjepa_cli.core.networks.encoder import Encoder
from hjepa_cli.core.networks.hierarchy import hold, plan_stride
from hjepa_cli.core.networks.model import KINDS, Model, load_modules
from hjepa_cli.core.plants.control_law import control_of
from hjepa_cli.core.plants.frames import FRAME_SHAPE, frames_of, frames_seen, remembers_from
from hjepa_cli.core.plants.named import camera_in
from hjepa_cli.core.plants.recorded import Recorded
from hjepa_cli.errors import DataError, NumericalError, UsageError, choices, require, shell
from hjepa_cli.plugins import METHODS
from hjepa_cli.storage import files
from hjepa_cli.storage.checkpoints import load_checkpoint
from hjepa_cli.wire.bundle import (
    BUCKETS,
    CHECK,
    MANIFEST,
    NETWORKS,
    SCHEMA,
    Bundle,
    files_of,
    open_bundle,
    too_large,
)
from hjepa_cli.wire.runtime import Runtime

CALIBRATION, CHECKED = 512, 256  # inputs, of trajectories 0 … and of held-out ones
FLOAT_CONVOLUTIONS = 7  # of the int8 encoder: the stem, and three of each of two stages
LARGEST_ERROR = 1e-5  # of z, and of forces ÷ limit, against torch
NOT_EXPORTED = ("linear", "hjepa-fused")  # plan with more than the networks of a bundle
OURS = {MANIFEST, CHECK, *(file for name in NETWORKS for file in files_of(name))}
Inputs = dict[str, tuple[tuple[int, ...], torch.dtype]]
"""Shape of a row and type of each input, by name."""
LARGEST_INT8 = {"rms_z": 0.015, "force_share": 0.035}  # of the forces' own root mean square


class _Seen(nn.Module):
    """It encodes pictures; their differences are taken in float, exact as in bfloat16."""

    def __init__(self, encoder: Encoder) -> None:
        super().__init__()
        self.encoder = encoder

    def forward(self, frames: Tensor) -> Tensor:
        seen = self.encoder.fitted(frames)
        earlier = seen[1:]
        if self.encoder.frame_input == "difference":
            earlier = [later - before for later, before in pairwise(seen)]
        return self.encoder.embed(torch.cat([seen[0], *earlier], dim=-1).permute(0, 3, 1, 2))


class _Plan(nn.Module):
    """It plays a stride: z [n, D] → forces_n [n, h, m] and the next z [n, D]."""

    def __init__(self, model: Model, planner: Hierarchy | OnePredictor) -> None:
        super().__init__()
        self.networks, self.force_limit_n = model.networks, model.force_limit_n
        self.stride = planner.stride
        self.strides = model.strides if isinstance(planner, Hierarchy) else None
        self.again = model.architecture["stride_actions"] == "all"

    def forward(self, z: Tensor) -> tuple[Tensor, Tensor]:
        networks: Any = self.networks
        act = networks["actor"].act
        if self.strides:
            high, medium, low = (networks[name] for name in ("high", "medium", "low"))
            actions, _, z_next = plan_stride(
                act, high, medium, low, z, self.strides, recompute_waypoint=self.again
            )
        else:
            actions = hold(act(z), self.stride)
            z_next = networks["high" if self.stride > 1 else "flat"](z, actions)
        return self.force_limit_n * actions.reshape(z.shape[0], self.stride, -1), z_next


class _Step(nn.Module):
    """It takes one stride under given forces: z [n, D], forces_n [n, h, m] → z [n, D]."""

    def __init__(self, predictor: nn.Module, force_limit_n: float) -> None:
        super().__init__()
        self.predictor, self.force_limit_n = predictor, force_limit_n

    def forward(self, z: Tensor, forces_n: Tensor) -> Tensor:
        stepped: Tensor = self.predictor(z, forces_n / self.force_limit_n)
        return stepped


class _Act(nn.Module):
    """It answers an embedding: z [n, D] → forces_n [n, m]."""

    def __init__(self, model: Model) -> None:
        super().__init__()
        self.actor: Any = model.networks["actor"]
        self.force_limit_n = model.force_limit_n

    def forward(self, z: Tensor) -> Tensor:
        acted: Tensor = self.force_limit_n * self.actor.act(z)
        return acted.reshape(z.shape[0], -1)


def load_fp32(path: Path) -> Model:
    """Load a checkpoint to compute in float32 on the CPU, whatever it was trained in."""
    checkpoint = load_checkpoint(path)
    metadata = copy.deepcopy(checkpoint.metadata)
    Model.load(path, "cpu")  # refuses what cannot drive
    metadata["settings"]["encoder"]["precision"] = "fp32"
    return Model(load_modules(checkpoint), metadata, checkpoint.digest, "cpu")


def exported_method(model: Model, method: str | None) -> str:
    """Return the method to export: the one asked for, or the first that plans in strides.

    Raises:
        UsageError: the model does not plan with it, or with any.
    """
    able = [
        name
        for name in methods_of(model)
        if name not in NOT_EXPORTED and _in_bundles(getattr(METHODS[name], "planner", None), model)
    ]
    if not able:
        raise UsageError(
            f"this model ({model.architecture['kind']}) plans no strides that a bundle can hold: "
            "those of hjepa or of one predictor",
            hint="hjepa models list; a hierarchy or a predictor of train-hierarchy can be exported",
        )
    if method is not None and method not in able:
        raise UsageError(f"this model cannot be exported as '{method}'; {choices(method, able)}")
    return method or able[0]


def _in_bundles(planner: Callable[[Model], Any] | None, model: Model) -> bool:
    """Say whether a method plans with the networks of a bundle; a plugin's may have others."""
    if planner is None or model.architecture["kind"] not in KINDS:
        return False
    return isinstance(planner(model), Hierarchy | OnePredictor)


def networks_of(model: Model, method: str) -> dict[str, tuple[nn.Module, Inputs, tuple[str, ...]]]:
    """Return the networks to export: module, inputs (name → shape and dtype) and output names."""
    planner: Any = planner_of(model, method)
    assert isinstance(planner, Hierarchy | OnePredictor)
    axes, size = math.prod(model.action_shape), model.architecture["embedding"]
    coarse = model.networks["high" if planner.stride > 1 else "flat"]
    limit_n, z = model.force_limit_n, ((size,), torch.float32)
    encoder = model.networks["encoder"]
    assert isinstance(encoder, Encoder)
    return {
        "encoder": (
            _Seen(encoder),
            {"frames": ((model.frames, *FRAME_SHAPE), torch.uint8)},
            ("z",),
        ),
        "planner": (_Plan(model, planner), {"z": z}, ("forces_n", "z_next")),
        "coarse": (
            _Step(coarse, limit_n),
            {"z": z, "forces_n": ((planner.stride, axes), torch.float32)},
            ("z_next",),
        ),
        "fine": (
            _Step(model.networks["flat"], limit_n),
            {"z": z, "forces_n": ((1, axes), torch.float32)},
            ("z_next",),
        ),
        "actor": (_Act(model), {"z": z}, ("forces_n",)),
    }


def check_pictures(model: Model, path: Path) -> None:
    """Raise UsageError for a model of recordings, or of pictures that are not 64 × 128 × 3.

    Exported networks are calibrated and compared on simulated pictures, and cameras of devices
    take those of one size.
    """
    if isinstance(model.plant, Recorded):
        raise UsageError(
            f"{path} learned from recordings; export compares networks on simulated pictures",
            hint="in Python, hjepa_cli.load_model(PATH) has encode(frames) and actor(z)",
        )
    if (shape := camera_in(model.architecture).frame_shape) != FRAME_SHAPE:
        sizes = [" × ".join(map(str, size)) for size in (shape, FRAME_SHAPE)]
        raise UsageError(f"{path} sees pictures of {sizes[0]}; devices take those of {sizes[1]}")


def check_sizes(model: Model, path: Path, method: str) -> None:
    """Raise UsageError for a model whose embeddings or strides are larger than a datagram."""
    axes, stride = math.prod(model.action_shape), planner_of(model, method).stride
    if why := too_large(model.plant_name, model.architecture["embedding"], axes, stride):
        raise UsageError(
            f"{path}: {why}",
            hint="hjepa models list, or train one: --h and encoder.embedding make it smaller",
        )


def exportable(path: Path, directory: Path, method: str | None) -> tuple[Model, str]:
    """Return the model of a checkpoint that may be exported to a directory, and the method.

    Raises:
        UsageError: the model has no such planner, its pictures are none that devices take,
            datagrams do not hold what it sends, or the directory holds something else.
        MissingInputError: onnx, onnxscript or onnxruntime are not installed.
    """
    model = load_fp32(path)
    check_pictures(model, path)
    method = exported_method(model, method)
    check_sizes(model, path, method)
    for module in ("onnx", "onnxscript", "onnxruntime"):
        require(module, f"export needs {module}", "export")
    files.refuse_foreign(directory, "exported model", OURS.__contains__)
    return model, method


def export(path: Path, directory: Path, method: str | None) -> Bundle:
    """Write a checkpoint's bundle into a directory, the manifest last.

    Raises as :func:`exportable`, and StorageError where the disk refuses.
    """
    model, method = exportable(path, directory, method)
    kind, entries = model.plant, dict[str, Any]()
    files.make_directory(directory)
    with files.writing(directory):
        (directory / MANIFEST).unlink(missing_ok=True)  # a half-written bundle has none
    seen = pictures(model, "train", CALIBRATION)
    for name, (network, inputs, outputs) in networks_of(model, method).items():
        data = _onnx(network, inputs, outputs)
        entries[name] = _write(directory, name, data, inputs, outputs)
        if name == "encoder":
            quantised = _int8(data, seen)
            entries["encoder-int8"] = _write(directory, "encoder-int8", quantised, inputs, outputs)
    manifest = {
        "schema": SCHEMA,
        "made_by": f"hjepa {__version__}",
        "plant": model.plant_name,
        "method": method,
        "checkpoint": {"name": path.parent.name, "sha256": model.digest},
        "embedding": model.architecture["embedding"],
        **{name: model.architecture[name] for name in LOOK if name in model.architecture},
        "frames": model.frames,
        "frame_shape": list(FRAME_SHAPE),
        "most_changed": min(most_changed(seen), 1.0),
        "camera": model.camera.manifest(),
        "action_shape": list(model.action_shape),
        "force_limit_n": model.force_limit_n,
        "stride": planner_of(model, method).stride,
        "step_s": kind.step_s,
        "payload": "int8",
        "buckets": list(BUCKETS),
        "networks": entries,
    }
    files.write_text(directory / MANIFEST, files.canonical_json(files.jsonable(manifest)))
    return open_bundle(directory)


def _write(
    directory: Path, name: str, data: bytes, inputs: Inputs, outputs: tuple[str, ...]
) -> dict[str, Any]:
    digests = {}
    for file, part in _split(data, name).items():
        files.write_bytes(directory / file, part)
        digests[file] = hashlib.sha256(part).hexdigest()
    described = {
        of: {"shape": ["n", *shape], "dtype": str(dtype).removeprefix("torch.")}
        for of, (shape, dtype) in inputs.items()
    }
    return {
        "files": digests,
        "inputs": described,
        "outputs": list(outputs),
        "precision": "int8" if name.endswith("int8") else "fp32",
    }


def _split(data: bytes, name: str) -> dict[str, bytes]:
    """Return a network's graph and its weights: a runtime holds weights from a file once less."""
    import onnx

    graph, weights = files_of(name)
    with tempfile.TemporaryDirectory() as scratch:
        onnx.save_model(
            onnx.load_from_string(data),
            Path(scratch, graph),
            save_as_external_data=True,
            location=weights,
            size_threshold=1024,
        )
        return {file: Path(scratch, file).read_bytes() for file in (graph, weights)}


def _onnx(module: nn.Module, inputs: Inputs, outputs: tuple[str, ...]) -> bytes:
    """Return a module as ONNX, its first axis of any length."""
    examples = tuple(torch.zeros(3, *shape, dtype=dtype) for shape, dtype in inputs.values())
    free = torch.export.Dim("n", min=1, max=2**16)
    with _quiet(), torch.inference_mode():
        program = torch.onnx.export(
            module.eval(),
            examples,
            input_names=list(inputs),
            output_names=list(outputs),
            dynamic_shapes=[{0: free}] * len(inputs),
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    data: bytes = program.model_proto.SerializeToString()
    return data


def _int8(data: bytes, frames: Pixels) -> bytes:
    """Return an encoder whose last convolutions read and multiply 8-bit integers."""
    import onnx
    from onnxruntime.quantization import (
        CalibrationDataReader,
        QuantFormat,
        QuantType,
        quantize_static,
    )

    class Pictures(CalibrationDataReader):  # type: ignore[misc]
        def __init__(self) -> None:
            self._parts = iter(np.array_split(frames, max(len(frames) // 32, 1)))

        def get_next(self) -> dict[str, Pixels] | None:
            part = next(self._parts, None)
            return None if part is None else {"frames": part}

    nodes = onnx.load_from_string(data).graph.node
    convolutions = [one.name for one in nodes if one.op_type == "Conv"]
    with tempfile.TemporaryDirectory() as scratch, _quiet():
        before, after = Path(scratch, "fp32.onnx"), Path(scratch, "int8.onnx")
        before.write_bytes(data)
        quantize_static(
            before,
            after,
            Pictures(),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=["Conv"],
            nodes_to_exclude=convolutions[:FLOAT_CONVOLUTIONS],
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            extra_options={"OpTypesToExcludeOutputQuantization": ["Conv"]},
        )
        return after.read_bytes()


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep exporters from telling what they do: this program says it."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with (
            warnings.catch_warnings(),
            open(os.devnull, "w") as nowhere,
            contextlib.redirect_stdout(nowhere),
            contextlib.redirect_stderr(nowhere),
        ):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


def pictures(model: Model, split: str, count: int) -> Pixels:
    """Return frames uint8 [count, κ, 64, 128, 3] of trajectories as the model was trained on."""
    collect = msgspec.convert(model.metadata["settings"]["collect"], CollectSettings)
    control = control_of(model.metadata["settings"], "the model")
    settings = Settings(plant=model.plant_name, collect=collect, control=control)
    rows = max(1, min(32, getattr(collect, _SIZES[split])))
    states = generate(settings, split, range(rows)).states.astype(np.float64)
    steps = np.arange(remembers_from(model.look), states.shape[1] - 1)
    windows = states[:, frames_seen(steps, model.look)]
    flat = windows.reshape(-1, *windows.shape[2:])
    chosen = np.random.default_rng(0).permutation(len(flat))[:count]
    return frames_of(model.camera, flat[chosen])


_SIZES = {"train": "trajectories", "clean": "clean_trajectories"}


def check(bundle: Bundle, path: Path, backend: str = "onnxruntime") -> dict[str, Any]:
    """Compare a bundle with its checkpoint in torch, and write ``check.json`` beside it.

    Pictures are of held-out clean rollouts. Differences are the largest of batches of 1, 2 and 64
    for fp32; of int8 the root mean square over all.

    Raises:
        NumericalError: a difference is larger than :data:`LARGEST_ERROR` or
            :data:`LARGEST_INT8`.
        DataError: a network is not the one that the manifest names.
    """
    model, method = load_fp32(path), bundle.manifest["method"]
    if model.digest != bundle.manifest["checkpoint"]["sha256"]:
        raise DataError(
            f"{bundle.directory} was exported from another checkpoint than {path}",
            hint=shell(["hjepa", "export", path, "--to", bundle.directory]),
        )
    bundle.verify()
    planner, runtime = planner_of(model, method), Runtime(bundle, backend)
    worst: dict[str, float] = {}
    frames, most = pictures(model, "clean", CHECKED), bundle.stride
    z = model.encode(frames)
    with torch.inference_mode():
        forces_n, z_next = planner.plan(z)
        acted_n = model.actor(z)
        ages = np.arange(len(z)) % (2 * most + 2)  # whole strides, and rests of them
        played_n = forces_n.repeat_interleave(3, dim=1)[:, : 2 * most + 1]
        followed = planner.follow(z, played_n, ages)
    for rows in (1, 2, 64):
        part, flat_n = z[:rows].numpy(), played_n[:rows].reshape(rows, 2 * most + 1, -1).numpy()
        stride_n, z_after = runtime.plan(part)
        pairs = {
            "z": (runtime.encode(frames[:rows]), z),
            "force": (runtime.act(part), acted_n / bundle.force_limit_n),
            "stride_force": (stride_n, forces_n / bundle.force_limit_n),
            "next_z": (z_after, z_next),
            "followed_z": (runtime.follow(part, flat_n, ages[:rows]), followed),
        }
        for name, (ours, theirs) in pairs.items():
            ours = ours / bundle.force_limit_n if name.endswith("force") else ours
            error = float(np.abs(ours.ravel() - theirs[:rows].numpy().ravel()).max())
            worst[name] = max(worst.get(name, 0.0), error)
    coded = torch.from_numpy(Runtime(bundle, backend, "int8").encode(frames))
    with torch.inference_mode():
        int8 = {
            "rms_z": float((coded - z).square().mean().sqrt()),
            "rms_force_n": float((model.actor(coded) - acted_n).square().mean().sqrt()),
        }
        int8["force_share"] = int8["rms_force_n"] / float(acted_n.square().mean().sqrt())
    measured = {"backend": backend, "n": len(frames), "max_error": worst, "int8": int8}
    files.write_json(bundle.directory / CHECK, measured)
    bad = [f"{name} {error:.1e}" for name, error in worst.items() if not error <= LARGEST_ERROR]
    bad += [f"int8 {n} {v:.3g}" for n, most in LARGEST_INT8.items() if not (v := int8[n]) <= most]
    if bad:
        raise NumericalError(
            f"{bundle.directory} differs from {path} in torch: {', '.join(bad)}",
            hint="do not drive with it; export again, and report it if it comes again",
        )
    return measured
