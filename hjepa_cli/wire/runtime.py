"""A runtime computes a bundle's networks with numpy arrays, by ONNX Runtime or OpenVINO.

Neither needs torch. Each network runs in one thread: a device has other things to do, and a
controller's batches are small. OpenVINO is fast with fixed shapes only, so that batches are filled
up to the next of :data:`~hjepa_cli.wire.bundle.BUCKETS`.
"""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.core.arrays import Integers, Pixels
from hjepa_cli.errors import DataError, UsageError, require
from hjepa_cli.wire.bundle import BUCKETS, Bundle

Singles = NDArray[np.float32]
Network = Callable[..., list[NDArray[Any]]]

BACKENDS = ("onnxruntime", "openvino")
PRECISIONS = ("fp32", "int8")


class Runtime:
    """It computes the networks of a bundle, each loaded when first used; threads may share it.

    Forces are [..., m] in newton, of one force m = 1.

    Args:
        bundle: the model.
        backend: one of :data:`BACKENDS`.
        precision: of the encoder; all else is fp32.

    Raises:
        MissingInputError: the backend is not installed.
    """

    def __init__(
        self, bundle: Bundle, backend: str = "onnxruntime", precision: str = "fp32"
    ) -> None:
        if backend not in BACKENDS:
            raise UsageError(f"unknown backend '{backend}'; choose from {', '.join(BACKENDS)}")
        extra = "runtime" if backend == "onnxruntime" else "openvino"
        require(backend, f"the runtime needs {backend}", extra)
        self.bundle, self.backend, self.precision = bundle, backend, precision
        self._open = _onnxruntime if backend == "onnxruntime" else _openvino
        self._networks: dict[str, Network] = {}

    def warm_up(self, *names: str) -> None:
        """Load networks now: the first step must not wait for it. Raises DataError."""
        for name in names:
            self._network(name)

    def encode(self, frames: Pixels) -> Singles:
        """Map pictures uint8 [n, κ, 64, 128, 3], the present one last, to embeddings [n, D]."""
        name = "encoder" if self.precision == "fp32" else f"encoder-{self.precision}"
        return self._run(name, frames)[0]

    def act(self, z: Singles) -> Singles:
        """Map embeddings [n, D] to the actor's forces [n, m]."""
        return self._run("actor", z)[0]

    def plan(self, z: Singles) -> tuple[Singles, Singles]:
        """Map embeddings [n, D] to a stride's forces [n, h, m] and the next embeddings [n, D]."""
        forces_n, z_next = self._run("planner", z)
        return forces_n, z_next

    def follow(self, z: Singles, forces_n: Singles, ages: Integers) -> Singles:
        """Move embeddings [n, D] on by ages [n] under forces [n, L, m].

        As :func:`hjepa_cli.core.control.planners.follow`: coarse strides as far as they go.
        """
        z, done = z.copy(), np.zeros_like(ages)
        for stride, name in ((self.bundle.stride, "coarse"), (1, "fine")):
            while len(rows := np.flatnonzero(ages - done >= stride)):
                steps = done[rows, None] + np.arange(stride)
                z[rows] = self._run(name, z[rows], forces_n[rows[:, None], steps])[0]
                done[rows] += stride
        return z

    def _network(self, name: str) -> Network:
        if name not in self._networks:
            self._networks[name] = self._open(self.bundle.network(name), name)
        return self._networks[name]

    def _run(self, name: str, *inputs: NDArray[Any]) -> list[NDArray[Any]]:
        network, count, most = self._network(name), len(inputs[0]), BUCKETS[-1]
        if self.backend == "onnxruntime" and count <= most:
            return network(*inputs)
        parts = []
        for start in range(0, count, most):
            part = [values[start : start + most] for values in inputs]
            rows = len(part[0])
            if self.backend == "openvino":
                bucket = next(size for size in BUCKETS if size >= rows)
                part = [_filled(values, bucket) for values in part]
            parts.append([output[:rows] for output in network(*part)])
        return [np.concatenate(of) for of in zip(*parts, strict=True)]


def _filled(values: NDArray[Any], rows: int) -> NDArray[Any]:
    """Return values with zeros behind, ``rows`` in all."""
    if len(values) == rows:
        return values
    filled = np.zeros((rows, *values.shape[1:]), values.dtype)
    filled[: len(values)] = values
    return filled


def _onnxruntime(path: Path, name: str) -> Network:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(path, options, ["CPUExecutionProvider"])
    except Exception as error:  # its own classes have no common base
        raise DataError(f"onnxruntime cannot load network '{name}': {_first(error)}") from None
    names = [one.name for one in session.get_inputs()]
    return lambda *inputs: session.run(None, dict(zip(names, inputs, strict=True)))


def _openvino(path: Path, name: str) -> Network:
    import openvino

    core, compiled = openvino.Core(), {}
    options = {"INFERENCE_NUM_THREADS": 1, "INFERENCE_PRECISION_HINT": "f32"}
    try:
        for rows in BUCKETS:  # all now: a compilation takes as long as many steps
            model = core.read_model(path)
            model.reshape({port: [rows, *port.partial_shape[1:]] for port in model.inputs})
            compiled[rows] = core.compile_model(model, "CPU", options).create_infer_request()
    except Exception as error:
        raise DataError(f"openvino cannot load network '{name}': {_first(error)}") from None

    one_at_a_time = threading.Lock()  # a request keeps its inputs and outputs in one place

    def run(*inputs: NDArray[Any]) -> list[NDArray[Any]]:
        with one_at_a_time:
            outputs = compiled[len(inputs[0])].infer(dict(enumerate(inputs)), share_inputs=True)
            return [np.array(outputs[port]) for port in outputs]

    return run


def _first(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)
