"""The WebSocket door speaks openpi's wire format: msgpack with arrays in it."""

import os
import subprocess
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hjepa_cli.core.plants.frames import FRAME_SHAPE
from hjepa_cli.wire import websocket
from hjepa_cli.wire.websocket import BadObservation, Client, pack, unpack

msgpack = pytest.importorskip("msgpack")


def theirs_pack(found):
    """Pack an array as openpi's client does, with the library that it uses."""
    if isinstance(found, np.ndarray):
        return {
            b"__ndarray__": True,
            b"data": found.tobytes(),
            b"dtype": found.dtype.str,
            b"shape": found.shape,
        }
    if isinstance(found, np.generic):
        return {b"__npgeneric__": True, b"data": found.item(), b"dtype": found.dtype.str}
    return found


def theirs_unpack(found):
    if b"__ndarray__" in found:
        return np.ndarray(found[b"shape"], np.dtype(found[b"dtype"]), found[b"data"])
    return found


@given(st.sampled_from(["uint8", "float32", "int64"]), st.lists(st.integers(1, 5), max_size=3))
def test_arrays_go_both_ways(dtype, shape):
    array = np.random.default_rng(0).integers(0, 100, shape).astype(dtype)
    value = {"a": {"b": array}, "n": 3, "text": "go", "none": None, "list": [1.5]}
    sent = msgpack.packb(value, default=theirs_pack)
    found = unpack(sent)
    np.testing.assert_array_equal(found["a"]["b"], array)
    assert found["a"]["b"].dtype == array.dtype and found["n"] == 3 and found["list"] == [1.5]
    back = msgpack.unpackb(pack(value), object_hook=theirs_unpack)
    np.testing.assert_array_equal(back["a"]["b"], array)
    assert unpack(msgpack.packb({"x": np.float32(2.5)}, default=theirs_pack)) == {"x": 2.5}


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        b"\xff" * 40,
        b"\x91" * 5000,
        msgpack.packb({"__ndarray__": True}),
        msgpack.packb({"__ndarray__": True, "data": b"12", "dtype": "<f4", "shape": [1]}),
        msgpack.packb({"__ndarray__": True, "data": b"12", "dtype": "O", "shape": [1]}),
        msgpack.packb({"__ndarray__": True, "data": b"1", "dtype": "u1", "shape": [-5, 2**60]}),
        msgpack.packb({"__ndarray__": True, "data": b"1", "dtype": [], "shape": 1}),
        msgpack.packb({"__ndarray__": True, "data": b"1", "dtype": ">,2", "shape": [1]}),
        msgpack.packb({"__npgeneric__": True, "data": 1000, "dtype": "|u1"}),
    ],
)
def test_what_is_no_message_is_refused(data):
    with pytest.raises(BadObservation):
        unpack(data)


@given(st.binary(max_size=200))
def test_noise_never_surprises(data):
    try:
        unpack(data)
    except BadObservation:
        pass


class Runtime:
    """It shows what it is asked."""

    def __init__(self):
        self.frames = []

    def encode(self, frames):
        self.frames.append(frames[0, :, 0, 0, 0].tolist())
        return np.full((1, 2), len(self.frames), np.float32)

    def plan(self, z):
        return np.full((1, 3, 1), z[0, 0], np.float32), z + 1


class Bundle:
    look, stride, axes, step_s = (1, 0), 3, 1, 0.001
    plant, digest = "desktop", bytes(32)
    manifest: ClassVar = {"method": "hjepa"}


def test_a_connection_remembers_the_last_pictures():
    runtime = Runtime()
    client = Client(Bundle, runtime)
    pictures = [np.full(FRAME_SHAPE, value, np.uint8) for value in (1, 2, 3)]
    actions = client.act({"observation/image": pictures[0]})["actions"]
    assert actions.shape == (websocket.CHUNK_STEPS, 1)
    assert actions[:7, 0].tolist() == [1, 1, 1, 2, 2, 2, 3]
    client.act({"image": np.stack(pictures[1:])})
    client.act({"pixels": pictures[0], "reset": True})
    assert runtime.frames == [[1, 1], [2, 3], [1, 1]]


def test_a_connection_remembers_pictures_that_are_further_apart():
    class Apart(Bundle):
        look = (4, 2, 0)

    runtime = Runtime()
    client = Client(Apart, runtime)
    for value in range(1, 8):
        client.act({"image": np.full(FRAME_SHAPE, value, np.uint8)})
    assert runtime.frames == [[max(now - back, 1) for back in (4, 2, 0)] for now in range(1, 8)]


@pytest.mark.parametrize(
    "observation",
    [
        None,
        {},
        {"image": np.zeros(FRAME_SHAPE, np.float32)},
        {"image": np.zeros((64, 64, 3), np.uint8)},
        {"image": "picture"},
        {"image": np.zeros((0, *FRAME_SHAPE), np.uint8)},
        {"image": np.zeros(FRAME_SHAPE, np.uint8), "reset": np.zeros(2, bool)},
    ],
)
def test_observations_without_a_picture_are_refused(observation):
    with pytest.raises(BadObservation, match="expected"):
        Client(Bundle, Runtime()).act(observation)


def test_a_ragged_picture_is_refused():
    with pytest.raises(BadObservation, match="the picture is no array"):
        Client(Bundle, Runtime()).act({"image": [[1, 2], [3]]})


@pytest.mark.parametrize(
    "sent",
    [
        {"image": [[1, 2], [3]]},
        {"image": {"__ndarray__": True, "data": b"", "dtype": "|u1", "shape": [0, 64, 128, 3]}},
        {"image": {"__npgeneric__": True, "data": -1, "dtype": "|u1"}},
    ],
)
def test_a_bad_observation_is_one_line_and_a_code(sent, caplog):
    connect = pytest.importorskip("websockets.sync.client").connect
    closed = pytest.importorskip("websockets.exceptions").ConnectionClosed
    with websocket.door("127.0.0.1", 0, Bundle, Runtime()) as (host, port):
        with connect(f"ws://{host}:{port}", compression=None) as connection:
            connection.recv()
            connection.send(msgpack.packb(sent))
            assert len(connection.recv().splitlines()) == 1
            with pytest.raises(closed):
                connection.recv()
            assert connection.close_code == 1003
    assert not caplog.records


def test_a_client_over_a_real_socket():
    connect = pytest.importorskip("websockets.sync.client").connect

    with websocket.door("127.0.0.1", 0, Bundle, Runtime()) as (host, port):
        with connect(f"ws://{host}:{port}", compression=None) as client:
            about = msgpack.unpackb(client.recv(), object_hook=theirs_unpack)
            assert about["plant"] == "desktop" and about["action_horizon"] == 16
            image = np.zeros(FRAME_SHAPE, np.uint8)
            client.send(msgpack.packb({"image": image}, default=theirs_pack))
            answer = msgpack.unpackb(client.recv(), object_hook=theirs_unpack)
            assert answer["actions"].shape == (16, 1)
            client.send(msgpack.packb({"image": 3}))
            assert "expected a picture" in client.recv()  # as text, which its clients raise


OPENPI = """
import sys, numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy
client = WebsocketClientPolicy(host="127.0.0.1", port=int(sys.argv[1]))
about = client.get_server_metadata()
answer = client.infer({"observation/image": np.zeros((64, 128, 3), np.uint8)})
print(about["plant"], about["action_horizon"], answer["actions"].shape, answer["actions"].dtype)
try:
    client.infer({"observation/image": np.zeros(3)})
except RuntimeError as error:
    print("expected a picture" in str(error))
"""


@pytest.mark.skipif("HJEPA_OPENPI_PYTHON" not in os.environ, reason="names a Python with openpi")
def test_openpis_own_client():
    """Its client wants numpy < 2, so it runs in an environment that a variable names."""

    with websocket.door("127.0.0.1", 0, Bundle, Runtime()) as (_, port):
        ran = subprocess.run(
            [os.environ["HJEPA_OPENPI_PYTHON"], "-c", OPENPI, str(port)],
            capture_output=True,
            text=True,
            timeout=60,
            env={"PATH": os.environ["PATH"]},
        )
    assert ran.stdout.split("\n")[:2] == ["desktop 16 (16, 1) float32", "True"], ran.stderr
