"""A WebSocket door serves clients that were written for policy servers in openpi's wire format.

Messages are msgpack; an array is a map with ``__ndarray__``, its bytes, dtype and shape. The server
first sends what it is, then answers each observation with a chunk of actions. This door is for slow
clients: TCP, one answer per question, no embedding on the device. A connection is a device: its
last pictures are kept, as the encoder sees motion between them.
"""

import contextlib
import threading
import time
from collections import deque
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from hjepa_cli.core.arrays import Pixels, array_from
from hjepa_cli.core.plants.frames import FRAME_SHAPE, frames_back
from hjepa_cli.errors import ArrayError, Unavailable, require
from hjepa_cli.wire.bundle import Bundle
from hjepa_cli.wire.runtime import Runtime

LARGEST_BYTES = 2**20
MOST_CLIENTS = 64
CHUNK_STEPS = 16
IMAGE_KEYS = ("observation/image", "image", "pixels")
_DTYPES = {"uint8", "int8", "int16", "int32", "int64", "float16", "float32", "float64", "bool"}


class BadObservation(ValueError):
    """A client sent what is no observation; it is told so."""


def pack(value: Any) -> bytes:
    """Return a value as msgpack, arrays as openpi's clients read them."""

    def plain(found: Any) -> Any:
        if isinstance(found, np.ndarray):
            described = {b"data": found.tobytes(), b"dtype": found.dtype.str, b"shape": found.shape}
            return {b"__ndarray__": True, **described}
        if isinstance(found, np.generic):
            return {b"__npgeneric__": True, b"data": found.item(), b"dtype": found.dtype.str}
        if isinstance(found, dict):
            return {key: plain(entry) for key, entry in found.items()}
        return found

    return msgspec.msgpack.encode(plain(value))


def unpack(data: bytes) -> Any:
    """Return what :func:`pack`, or a client's own, made of a value; no code runs.

    Raises:
        BadObservation: it is not msgpack, or an array is not what it says.
    """

    def whole(found: Any) -> Any:
        if isinstance(found, list):
            return [whole(entry) for entry in found]
        if not isinstance(found, dict):
            return found
        found = {key.decode() if isinstance(key, bytes) else key: v for key, v in found.items()}
        if "__ndarray__" in found or "__npgeneric__" in found:
            return _array(found)
        return {key: whole(entry) for key, entry in found.items()}

    try:
        return whole(msgspec.msgpack.decode(data))
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, TypeError) as error:
        raise BadObservation(f"not msgpack: {error}") from None


def _array(found: dict[str, Any]) -> Any:
    try:
        dtype = np.dtype(found["dtype"])
        if dtype.name not in _DTYPES:
            raise BadObservation(f"an array of {dtype}; expected numbers")
        if "__npgeneric__" in found:
            return dtype.type(found["data"])
        return np.frombuffer(found["data"], dtype).reshape(found["shape"])
    except (KeyError, OverflowError, SyntaxError, TypeError, ValueError) as error:
        raise BadObservation(f"an array that is not what it says: {error}") from None


class Client:
    """It remembers a client's last pictures and answers its observations."""

    def __init__(self, bundle: Bundle, runtime: Runtime) -> None:
        self._bundle, self._runtime = bundle, runtime
        self._back = frames_back(bundle.look)
        self._seen: deque[Pixels] = deque(maxlen=bundle.look[0] + 1)

    def act(self, observation: Any) -> dict[str, Any]:
        """Return ``{"actions": float32 [16, m]}`` in newton, of this step and the next ones.

        Raises:
            BadObservation: there is no picture of the right size and type in it.
        """
        if not isinstance(observation, dict):
            raise BadObservation("expected a map with the picture under " + " or ".join(IMAGE_KEYS))
        found = [observation[key] for key in IMAGE_KEYS if key in observation]
        try:
            pictures: NDArray[Any] = array_from(found[0] if found else [], "the picture")
            begins_anew = bool(observation.get("reset"))
        except ArrayError as error:
            raise BadObservation(error.message) from None
        except ValueError:
            raise BadObservation("reset is an array; expected true or false") from None
        if pictures.shape == FRAME_SHAPE:
            pictures = pictures[None]
        fitting = pictures.dtype == np.uint8 and pictures.shape[1:] == FRAME_SHAPE
        if not fitting or not len(pictures):
            raise BadObservation(
                f"expected a picture {list(FRAME_SHAPE)} of uint8, RGB, or several [n, …] with the "
                f"newest last, under {' or '.join(IMAGE_KEYS)}"
            )
        if begins_anew:
            self._seen.clear()
        for picture in pictures:
            while len(self._seen) < self._seen.maxlen - 1:  # type: ignore[operator]
                self._seen.append(picture)
            self._seen.append(picture)
        seen = np.stack([self._seen[at] for at in self._back])
        z, strides = self._runtime.encode(seen[None]), []
        for _ in range(-(-CHUNK_STEPS // self._bundle.stride)):
            forces_n, z = self._runtime.plan(z)
            strides.append(forces_n[0])
        return {"actions": np.concatenate(strides)[:CHUNK_STEPS]}


@contextlib.contextmanager
def door(host: str, port: int, bundle: Bundle, runtime: Runtime) -> Iterator[tuple[str, int]]:
    """Serve clients from threads; yield host and port.

    Raises:
        MissingInputError: websockets is not installed.
        Unavailable: the port is taken.
    """
    require("websockets", "--websocket needs websockets", "runtime")
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.server import ServerConnection, serve

    metadata = {
        "plant": bundle.plant,
        "method": bundle.manifest["method"],
        "model": bundle.digest.hex(),
        "action_horizon": CHUNK_STEPS,
        "action_dim": bundle.axes,
        "action_unit": "N",
        "step_s": bundle.step_s,
        "image": list(FRAME_SHAPE),
    }
    places = threading.BoundedSemaphore(MOST_CLIENTS)

    def handle(connection: ServerConnection) -> None:
        if not places.acquire(blocking=False):
            connection.close(1013, "too many clients")
            return
        try:
            client = Client(bundle, runtime)
            connection.send(pack(metadata))
            for message in connection:
                started_s = time.monotonic()
                try:
                    if not isinstance(message, bytes):
                        raise BadObservation("expected a binary message")
                    answer = client.act(unpack(message))
                except BadObservation as error:  # openpi's clients raise what they get as text
                    connection.send(str(error))
                    connection.close(1003, "bad observation")
                    return
                infer_ms = 1e3 * (time.monotonic() - started_s)
                connection.send(pack({**answer, "server_timing": {"infer_ms": infer_ms}}))
        except ConnectionClosed:
            pass
        finally:
            places.release()

    try:
        server = serve(handle, host, port, compression=None, max_size=LARGEST_BYTES)
    except OSError as error:
        raise Unavailable(
            f"--websocket {host}:{port}: {error.strerror}", hint="choose another port"
        ) from None
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield host, server.socket.getsockname()[1]
    finally:
        server.shutdown()
        thread.join()
