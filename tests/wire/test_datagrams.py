"""Datagrams: what one side packs the other reads, and nothing else is read at all."""

import resource
import struct
import tracemalloc

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from hjepa_cli.core.control.codecs.integers import Integers
from hjepa_cli.errors import DataError, MissingInputError, StorageError
from hjepa_cli.wire import auth, protocol
from hjepa_cli.wire.protocol import Answer, Bye, Embedding, Forces, Hello

KEY = bytes(range(32))
U32 = st.integers(0, 2**32 - 2)
FLOAT = st.floats(-1e6, 1e6, width=32)


def same(left, right):
    for ours, theirs in zip(left, right, strict=True):
        np.testing.assert_array_equal(ours, theirs)


@given(device=U32, period=st.integers(1, 2**32 - 1), nonce=st.binary(min_size=8, max_size=8))
def test_hello_and_answer_come_back(device, period, nonce):
    hello = Hello(device, nonce, period, 256, 1, protocol.INT8, bytes(32), "desktop")
    assert protocol.parse(auth.tagged(KEY, protocol.pack_hello(hello))) == hello
    answer = Answer(device, nonce, nonce[::-1], protocol.OTHER_MODEL, bytes(32), "gym")
    assert protocol.parse(auth.tagged(KEY, protocol.pack_answer(answer))) == answer
    assert protocol.parse(auth.tagged(KEY, protocol.pack_bye(Bye(device)))) == Bye(device)


@given(
    step=st.integers(255, 2**31 - 1),
    age=st.integers(0, 255),
    forces=st.lists(FLOAT, min_size=1, max_size=8),
    codes=st.binary(min_size=1, max_size=512),
    lag=st.integers(0, 2**16 - 1),
)
def test_embedding_comes_back(step, age, forces, codes, lag):
    packet = Embedding(
        *(7, step, age, np.array(forces, np.float32), 3, protocol.LOCAL, 200, protocol.NO_STEP),
        *(lag, 4.0, np.frombuffer(codes, np.int8)),
    )
    found = protocol.parse(auth.tagged(KEY, protocol.pack_embedding(packet)))
    same(found, packet)
    assert found.capture == step - age


@given(
    first=st.integers(0, 2**31),
    steps=st.integers(1, 16),
    axes=st.integers(1, 4),
    seed=st.integers(0, 99),
)
def test_forces_come_back(first, steps, axes, seed):
    forces_n = np.random.default_rng(seed).normal(size=(steps, axes)).astype(np.float32)
    packet = Forces(1, 2, first, first, forces_n)
    same(protocol.parse(auth.tagged(KEY, protocol.pack_forces(packet))), packet)


def test_sizes_are_those_of_the_documentation():
    z = np.zeros(256, np.int8)
    force_n = np.zeros(1, np.float32)
    up = Embedding(1, 0, 0, force_n, 0, 0, 0, protocol.NO_STEP, 0, 1.0, z)
    assert len(auth.tagged(KEY, protocol.pack_embedding(up))) == 28 + 4 + 256 + 16
    down = Forces(1, 1, 0, 0, np.zeros((16, 1), np.float32))
    assert len(auth.tagged(KEY, protocol.pack_forces(down))) == 24 + 64 + 16


def test_offsets_are_those_of_the_documentation():
    """They are read here with struct alone, as a microcontroller's program would."""
    force_n, codes = np.array([-2.5], np.float32), np.arange(-3, 3, dtype=np.int8)
    packet = Embedding(0x01020304, 1000, 5, force_n, 2, 1, 9, 900, 3, 4.0, codes)
    data = protocol.pack_embedding(packet)
    assert data[:4] == b"HJ\x01\x03"
    assert struct.unpack_from("<II", data, 4) == (0x01020304, 1000)
    assert list(data[12:16]) == [5, 2, 1, 9]
    assert struct.unpack_from("<IHeHB", data, 16) == (900, 3, 4.0, 6, 1)
    assert struct.unpack_from("<f6b", data, 28) == (-2.5, *range(-3, 3))


@given(st.binary(max_size=400))
def test_noise_is_malformed(data):
    with pytest.raises(protocol.Malformed):
        protocol.parse(data)


@given(st.data())
def test_cut_or_changed_datagrams_never_surprise(data):
    """A changed byte makes either another message of the same type, or Malformed; never more."""
    packet = Forces(1, 2, 3, 4, np.ones((4, 1), np.float32))
    whole = bytearray(auth.tagged(KEY, protocol.pack_forces(packet)))
    at = data.draw(st.integers(0, len(whole) - 1))
    whole[at] ^= data.draw(st.integers(1, 255))
    assert not auth.is_tagged(KEY, bytes(whole))
    for cut in (bytes(whole), bytes(whole[:at])):
        try:
            protocol.parse(cut)
        except protocol.Malformed:
            pass


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_force_that_is_not_finite_is_refused(bad):
    packet = Forces(1, 2, 3, 4, np.full((4, 1), bad, np.float32))
    with pytest.raises(protocol.Malformed, match="finite"):
        protocol.parse(auth.tagged(KEY, protocol.pack_forces(packet)))


@given(st.integers(2**31, 2**32 - 1))
def test_a_step_that_no_session_has_is_refused(step):
    packet = Embedding(*(7, step, 0, np.ones(1, np.float32)), *(0,) * 5, 4.0, np.ones(8, np.int8))
    with pytest.raises(protocol.Malformed, match="step"):
        protocol.parse(auth.tagged(KEY, protocol.pack_embedding(packet)))


def test_another_version_is_told_apart():
    data = bytearray(auth.tagged(KEY, protocol.pack_bye(Bye(1))))
    data[2] = 9
    with pytest.raises(protocol.OtherVersion):
        protocol.parse(bytes(data))


@given(st.integers(0, 200))
def test_the_wire_codes_as_the_simulator_does(seed):
    """Scale and codes are those of the codec int8 that curves are measured with, to the bit."""
    random = np.random.default_rng(seed)
    z = random.normal(size=256).astype(np.float32) * np.float32(10.0 ** random.uniform(-6, 6))
    scale, codes = protocol.encode_int8(z)
    theirs, their_scale = Integers(256, 8).encode(torch.from_numpy(z)[None])
    assert scale == float(their_scale[0])
    np.testing.assert_array_equal(codes, theirs[0].numpy())
    np.testing.assert_array_equal(
        protocol.decode_int8(scale, codes), Integers(256, 8).decode(theirs, their_scale)[0].numpy()
    )


# -- tags, keys, replays


def test_the_tag_is_hmac_sha256_of_rfc_4231():
    """Test case 2 of RFC 4231, cut to 16 bytes as its test case 5 is."""
    body = b"what do ya want for nothing?"
    expected = bytes.fromhex("5bdcc146bf60754e6a042426089575c7")
    assert auth.tagged(b"Jefe", body) == body + expected


def test_session_keys_differ_by_every_part():
    parts = [(KEY, 1, b"a" * 8, b"b" * 8), (KEY, 2, b"a" * 8, b"b" * 8)]
    parts += [
        (KEY, 1, b"c" * 8, b"b" * 8),
        (KEY, 1, b"a" * 8, b"c" * 8),
        (bytes(32), *parts[0][1:]),
    ]
    assert len({auth.session_key(*one) for one in parts}) == len(parts)


@given(st.lists(st.integers(0, 150), max_size=120))
def test_the_replay_window_accepts_each_step_once(steps):
    """Against a set that remembers everything: new, late within the window, or doubled."""
    window, seen = auth.ReplayWindow(), set()
    for step in steps:
        newest = max(seen, default=-1)
        verdict = window.judge(step)
        if step in seen or (step < newest and newest - step >= auth.WINDOW):
            assert verdict == "doubled"
        else:
            assert verdict == ("new" if step > newest else "late")
            seen.add(step)


def test_keys_are_made_safe_and_refused_where_others_may_read(tmp_path):
    path = tmp_path / "deep" / "wire.key"
    with pytest.raises(MissingInputError, match="does not exist"):
        auth.key_of(path)
    key = auth.key_of(path, make=True)
    assert len(key) == 32 and path.stat().st_mode & 0o777 == 0o600
    assert auth.key_of(path) == key
    path.chmod(0o644)
    with pytest.raises(DataError, match="0644"):
        auth.key_of(path)
    path.chmod(0o600)
    path.write_bytes(b"short")
    with pytest.raises(DataError, match="5 bytes"):
        auth.key_of(path)


def test_a_full_disk_leaves_no_key_that_is_empty(tmp_path):
    """The kernel refuses the bytes and not the name, as a full disk does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        with pytest.raises(StorageError, match="too large"):
            auth.key_of(tmp_path / "wire.key", make=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []
    assert len(auth.key_of(tmp_path / "wire.key", make=True)) == 32


def test_parsing_keeps_nothing():
    """Ten thousand datagrams leave no memory behind."""
    data = auth.tagged(KEY, protocol.pack_forces(Forces(1, 2, 3, 4, np.ones((4, 1), np.float32))))
    protocol.parse(data)
    tracemalloc.start()
    for _ in range(10_000):
        protocol.parse(data)
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 50_000
