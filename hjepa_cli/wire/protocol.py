"""Datagrams have fixed layouts, byte by byte; docs/reference/protocol.md is their reference.

All numbers are little-endian. Every datagram begins with ``HJ``, the version and its type, and ends
with a tag (:mod:`hjepa_cli.wire.auth`). Nothing here trusts a byte: a datagram whose length is not
exactly that of its type and counts, or that holds what no sender of ours writes, is
:class:`Malformed`.
"""

import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

MAGIC, VERSION = b"HJ", 1
HELLO, ANSWER, EMBEDDING, FORCES, BYE = 1, 2, 3, 4, 5
TAG_BYTES = 16
LARGEST_BYTES = 1200  # fits any link's packet, IPv6 tunnels included
NO_STEP = 2**32 - 1
MOST_STEPS = 2**31  # of a session; no number of it reaches 32 bits until it ends
TRIES = 4  # newest hellos of a device that may lead to a session: the first proved one stays
MOST_FORCES = 64  # of all steps and axes of a datagram

WELCOME, OTHER_MODEL, OTHER_VERSION, FULL, UNSUITED = 0, 1, 2, 3, 4
PLANNED, HELD, LOCAL, ZERO = 0, 1, 2, 3  # where the last force came from
SOURCES = ("planned", "held", "local", "zero")

INT8 = 1  # the codec: int8 codes against one float16 scale

_HEAD = struct.Struct("<2sBBI")
_HELLO = struct.Struct("<2sBBI8sIHBBBBH32s16s")
_ANSWER = struct.Struct("<2sBBI8s8sBBH32s16s")
_EMBEDDING = struct.Struct("<2sBBIIBBBBIHeHBB")
_FORCES = struct.Struct("<2sBBIIIIBBH")
_BYE = struct.Struct("<2sBBIBBH")


class Malformed(ValueError):
    """These bytes are no datagram of this protocol."""


class OtherVersion(Malformed):
    """A datagram of another version of the protocol: ``args[0]``."""


class Hello(NamedTuple):
    """A device introduces itself.

    Attributes:
        device: its number.
        nonce: 8 random bytes, new for every session.
        period_us: of its control step, in wall time.
        embedding: D.
        forces: m of its plant, 1 of one force.
        codec: how it sends embeddings, :data:`INT8`.
        model: sha256 of its model's manifest.
        plant: its plant's name.
    """

    device: int
    nonce: bytes
    period_us: int
    embedding: int
    forces: int
    codec: int
    model: bytes
    plant: str


class Answer(NamedTuple):
    """The controller answers a hello; ``reason`` is :data:`WELCOME` or why not."""

    device: int
    nonce: bytes
    server_nonce: bytes
    reason: int
    model: bytes
    plant: str


class Embedding(NamedTuple):
    """A device sends what it saw.

    Attributes:
        device: its number.
        step: the control step it is in, below :data:`MOST_STEPS`.
        capture_age: steps since the embedding was captured.
        forces_n: the last force that it applied [m].
        force_age: steps since the step that force was for.
        source: where it came from, as :data:`PLANNED`.
        number: of the session's embeddings, modulo 256: a gap in it is what was lost.
        answered: capture step of the newest embedding that forces have come back for, or
            :data:`NO_STEP`.
        lag_steps: steps from that capture to the answer; without one, of the hello's answer.
        scale, codes: of the embedding: z = codes · scale / 127, int8 [D].
    """

    device: int
    step: int
    capture_age: int
    forces_n: NDArray[np.float32]
    force_age: int
    source: int
    number: int
    answered: int
    lag_steps: int
    scale: float
    codes: NDArray[np.int8]

    @property
    def capture(self) -> int:
        """Return the control step in which the embedding was captured."""
        return self.step - self.capture_age


class Forces(NamedTuple):
    """The controller foresees forces.

    Attributes:
        device: whose they are.
        counter: of the session's datagrams; a higher one is newer.
        base: capture step of the embedding that they follow from.
        first: the step of the first.
        forces_n: of that step and the next ones [L, m].
    """

    device: int
    counter: int
    base: int
    first: int
    forces_n: NDArray[np.float32]


class Bye(NamedTuple):
    """One side ends the session."""

    device: int


Message = Hello | Answer | Embedding | Forces | Bye


def pack_hello(m: Hello) -> bytes:
    """Return a hello without its tag."""
    return _HELLO.pack(
        *(MAGIC, VERSION, HELLO, m.device, m.nonce, m.period_us, m.embedding, m.forces),
        *(m.codec, 0, 0, 0, m.model, m.plant.encode()),
    )


def pack_answer(m: Answer) -> bytes:
    """Return an answer without its tag."""
    return _ANSWER.pack(
        *(MAGIC, VERSION, ANSWER, m.device, m.nonce, m.server_nonce, m.reason, 0, 0),
        *(m.model, m.plant.encode()),
    )


def pack_embedding(m: Embedding) -> bytes:
    """Return an embedding's datagram without its tag."""
    head = _EMBEDDING.pack(
        *(MAGIC, VERSION, EMBEDDING, m.device, m.step, m.capture_age, m.force_age, m.source),
        *(m.number, m.answered, m.lag_steps, m.scale, len(m.codes), len(m.forces_n), 0),
    )
    return head + m.forces_n.astype("<f4").tobytes() + m.codes.tobytes()


def embedding_bytes(embedding: int, forces: int) -> int:
    """Return the length of an embedding's datagram with its tag, of D codes and m forces."""
    return _EMBEDDING.size + 4 * forces + embedding + TAG_BYTES


def pack_forces(m: Forces) -> bytes:
    """Return forces' datagram without its tag."""
    steps, axes = m.forces_n.shape
    head = _FORCES.pack(
        MAGIC, VERSION, FORCES, m.device, m.counter, m.base, m.first, steps, axes, 0
    )
    return head + m.forces_n.astype("<f4").tobytes()


def pack_bye(m: Bye) -> bytes:
    """Return a bye without its tag."""
    return _BYE.pack(MAGIC, VERSION, BYE, m.device, 0, 0, 0)


def peek(data: bytes) -> tuple[int, int]:
    """Return type and device of a datagram.

    Raises:
        OtherVersion: it is of another version.
        Malformed: it is not one of this protocol.
    """
    if not _HEAD.size + TAG_BYTES <= len(data) <= LARGEST_BYTES:
        raise Malformed("length")
    magic, version, kind, device = _HEAD.unpack_from(data)
    if magic != MAGIC:
        raise Malformed("magic")
    if version != VERSION:
        raise OtherVersion(version)
    if kind not in _PARSERS:
        raise Malformed("type")
    return kind, device


def parse(data: bytes) -> Message:
    """Return what a datagram says, its tag included in ``data`` but not looked at.

    Raises:
        Malformed: it is not one of this protocol.
    """
    kind, _ = peek(data)
    return _PARSERS[kind](data)


def _unpack(layout: struct.Struct, data: bytes, further_bytes: int = 0) -> tuple[Any, ...]:
    if len(data) != layout.size + further_bytes + TAG_BYTES:
        raise Malformed("length")
    return layout.unpack_from(data)


def _zero(*reserved: int) -> None:
    if any(reserved):
        raise Malformed("reserved bits")


def _name(field: bytes) -> str:
    text = field.rstrip(b"\0")
    if not text or not all(33 <= byte < 127 for byte in text):
        raise Malformed("plant")
    return text.decode()


def _floats(data: bytes, count: int, offset: int) -> NDArray[np.float32]:
    values = np.frombuffer(data, "<f4", count, offset)
    if not np.isfinite(values).all():
        raise Malformed("a force that is not finite")
    return values


def _hello(data: bytes) -> Hello:
    found = _unpack(_HELLO, data)
    _, _, _, device, nonce, period_us, embedding, forces, codec, *reserved, model, plant = found
    _zero(*reserved)
    if not period_us or not embedding or not forces:
        raise Malformed("sizes")
    return Hello(device, nonce, period_us, embedding, forces, codec, model, _name(plant))


def _answer(data: bytes) -> Answer:
    _, _, _, device, nonce, server_nonce, reason, *reserved, model, plant = _unpack(_ANSWER, data)
    _zero(*reserved)
    return Answer(device, nonce, server_nonce, reason, model, _name(plant))


def _embedding(data: bytes) -> Embedding:
    if len(data) < _EMBEDDING.size:
        raise Malformed("length")
    *_, count, axes, _ = _EMBEDDING.unpack_from(data)
    found = _unpack(_EMBEDDING, data, 4 * axes + count)
    _, _, _, device, step, capture_age, force_age, source, *rest = found
    number, answered, lag_steps, scale, _, _, reserved = rest
    _zero(reserved)
    if step >= MOST_STEPS:
        raise Malformed("a step that no session has")
    if capture_age > step or source >= len(SOURCES) or not (np.isfinite(scale) and scale >= 0):
        raise Malformed("an embedding's numbers")
    forces_n = _floats(data, axes, _EMBEDDING.size)
    codes = np.frombuffer(data, np.int8, count, _EMBEDDING.size + 4 * axes)
    return Embedding(
        *(device, step, capture_age, forces_n, force_age, source, number, answered, lag_steps),
        *(scale, codes),
    )


def _forces(data: bytes) -> Forces:
    if len(data) < _FORCES.size:
        raise Malformed("length")
    *_, steps, axes, _ = _FORCES.unpack_from(data)
    if not 0 < steps * axes <= MOST_FORCES:
        raise Malformed("sizes")
    _, _, _, device, counter, base, first, _, _, reserved = _unpack(_FORCES, data, 4 * steps * axes)
    _zero(reserved)
    if first + steps > NO_STEP or base > first:
        raise Malformed("steps")
    forces_n = _floats(data, steps * axes, _FORCES.size).reshape(steps, axes)
    return Forces(device, counter, base, first, forces_n)


def _bye(data: bytes) -> Bye:
    _, _, _, device, *reserved = _unpack(_BYE, data)
    _zero(*reserved)
    return Bye(device)


_PARSERS: dict[int, Callable[[bytes], Message]] = {
    HELLO: _hello,
    ANSWER: _answer,
    EMBEDDING: _embedding,
    FORCES: _forces,
    BYE: _bye,
}


def encode_int8(z: NDArray[np.float32]) -> tuple[float, NDArray[np.int8]]:
    """Return scale and codes of an embedding [D].

    They are those of :meth:`hjepa_cli.core.control.codecs.integers.Integers.encode`: codes are
    taken against the scale that float16 has left.
    """
    scale = np.float16(min(np.abs(z).max(initial=0.0), 65_504.0))
    step = np.float32(scale) / np.float32(127)
    if not step:
        return 0.0, np.zeros(z.shape, np.int8)
    codes = np.clip(np.rint(z.astype(np.float32) / step), -127, 127)
    return float(scale), codes.astype(np.int8)


def decode_int8(scale: float, codes: NDArray[np.int8]) -> NDArray[np.float32]:
    """Invert :func:`encode_int8`: float32 [D]."""
    return codes.astype(np.float32) * (np.float32(scale) / np.float32(127))
