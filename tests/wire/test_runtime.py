"""A runtime gives every caller the result of its own inputs, however many threads call it."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from hjepa_cli.wire.runtime import Runtime

D, CLIENTS = 64, 4


class OneNetwork:
    """A bundle whose networks are all one: z → max(z W, 0) V, written without torch."""

    def __init__(self, path):
        from onnx import TensorProto, helper, numpy_helper, save

        random = np.random.default_rng(0)
        weights = {name: random.normal(size=(D, D)).astype(np.float32) / 8 for name in "wv"}
        nodes = [
            helper.make_node("MatMul", ["z", "w"], ["a"]),
            helper.make_node("Relu", ["a"], ["b"]),
            helper.make_node("MatMul", ["b", "v"], ["forces_n"]),
        ]
        ends = [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", D])
            for name in ("z", "forces_n")
        ]
        constants = [numpy_helper.from_array(value, name) for name, value in weights.items()]
        graph = helper.make_graph(nodes, "net", ends[:1], ends[1:], constants)
        opset = [helper.make_opsetid("", 17)]
        save(helper.make_model(graph, opset_imports=opset, ir_version=8), path)
        self._path = path

    def network(self, name):
        return self._path


@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
def test_threads_get_their_own_results(backend, tmp_path):
    """The clients of a WebSocket door share a runtime: each must be driven by its own pictures."""
    for module in (backend, "onnx"):
        pytest.importorskip(module)
    runtime = Runtime(OneNetwork(tmp_path / "net.onnx"), backend)
    inputs = np.random.default_rng(1).normal(size=(CLIENTS, 1, D)).astype(np.float32)
    alone = [runtime.act(z) for z in inputs]

    def wrong(client):
        answers = (runtime.act(inputs[client]) for _ in range(300))
        return sum(not np.allclose(found, alone[client], atol=1e-4) for found in answers)

    with ThreadPoolExecutor(CLIENTS) as threads:
        assert list(threads.map(wrong, range(CLIENTS))) == [0] * CLIENTS
