"""Checkpoints: what was saved comes back bit for bit; anything else is refused by name."""

import hashlib
import json
import os
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors import numpy as safetensors_numpy

from hjepa_cli.errors import DataError, HjepaError, MissingInputError, NumericalError
from hjepa_cli.storage.checkpoints import SCHEMA, check_tensors, load_checkpoint, save_checkpoint

TENSORS = {
    "encoder.weight": np.arange(300, dtype=np.float32).reshape(3, 100) / 7,
    "encoder.batches": np.array(12),
    "frame_mean": np.linspace(0, 1, 5, dtype=np.float32),
}
METADATA = {"architecture": {"h": 4, "m": 2, "l": 1}, "health": {"r2": [0.98, None]}, "note": "λ"}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    save_checkpoint(tmp_path / "model.safetensors", TENSORS, METADATA)
    return tmp_path / "model.safetensors"


def rewrite(path: Path, tensors: dict[str, np.ndarray], metadata: dict[str, Any]) -> None:
    """Write a checkpoint whose own digest is right, whatever it holds."""
    sealed = {"schema": SCHEMA, **metadata, "sha256": ""}
    digest = independent_digest(sealed, tensors)
    text = json.dumps({**sealed, "sha256": digest})
    path.write_bytes(safetensors_numpy.save(tensors, {"hjepa": text}))


def independent_digest(sealed: dict[str, Any], tensors: dict[str, np.ndarray]) -> str:
    """The digest, written again from its definition in docs/explanation/architecture.md."""
    compact = {"separators": (",", ":"), "ensure_ascii": False}
    data = json.dumps(sealed, sort_keys=True, **compact).encode()  # type: ignore[arg-type]
    for name, array in sorted(tensors.items()):
        head = [name, str(array.dtype), list(array.shape)]
        data += json.dumps(head, **compact).encode() + array.tobytes()  # type: ignore[arg-type]
    return hashlib.sha256(data).hexdigest()


def test_round_trip(path: Path) -> None:
    checkpoint = load_checkpoint(path)
    assert checkpoint.metadata == METADATA
    assert checkpoint.tensors.keys() == TENSORS.keys()
    for name, array in TENSORS.items():
        assert checkpoint.tensors[name].dtype == array.dtype
        assert checkpoint.tensors[name].shape == array.shape
        assert checkpoint.tensors[name].tobytes() == array.tobytes()
    sealed = {**METADATA, "schema": SCHEMA, "sha256": ""}
    assert checkpoint.digest == independent_digest(sealed, TENSORS)


@given(
    shape=st.lists(st.integers(0, 4), max_size=4),
    dtype=st.sampled_from([np.float32, np.int64]),
    data=st.data(),
)
def test_any_memory_layout_round_trips(
    tmp_path_factory: pytest.TempPathFactory,
    shape: list[int],
    dtype: type,
    data: st.DataObject,
) -> None:
    """safetensors itself writes wrong values for strided arrays without a word."""
    steps = [data.draw(st.sampled_from([1, 2, -1, -2])) for _ in shape]
    base = np.arange(np.prod([2 * n for n in shape], dtype=int)).astype(dtype)
    order = data.draw(st.sampled_from(["C", "F"]))
    array = base.reshape([2 * n for n in shape], order=order)
    array = array[tuple(slice(None, None, step) for step in steps)]
    array = array.transpose(data.draw(st.permutations(range(array.ndim))))
    if data.draw(st.booleans()):
        array = array.astype(array.dtype.newbyteorder(">"))
    file = tmp_path_factory.getbasetemp() / "layout.safetensors"
    first = save_checkpoint(file, {"a": array}, {})
    loaded = load_checkpoint(file).tensors["a"]
    assert loaded.shape == array.shape and loaded.dtype == np.dtype(dtype)
    np.testing.assert_array_equal(loaded, array)
    assert save_checkpoint(file, {"a": loaded}, {}) == first


def test_equal_content_gives_equal_bytes(tmp_path: Path) -> None:
    """Nothing random, no order of insertion, no stride and no time enters the file."""
    written = set()
    for turn in range(20):
        names = sorted(TENSORS, reverse=bool(turn % 2))
        order = "F" if turn % 3 else "C"
        tensors = {name: np.array(TENSORS[name], order=order) for name in names}
        metadata = {key: METADATA[key] for key in sorted(METADATA, reverse=bool(turn % 2))}
        save_checkpoint(tmp_path / "a", tensors, metadata)
        written.add((tmp_path / "a").read_bytes())
    assert len(written) == 1


def test_every_flipped_bit_is_noticed(path: Path) -> None:
    """In the header and in every 25th byte of the data, whichever bit."""
    good = path.read_bytes()
    header_end = 8 + struct.unpack("<Q", good[:8])[0]
    assert header_end < len(good) - 1000
    for position in [*range(0, header_end, 3), *range(header_end, len(good), 25), len(good) - 1]:
        bad = bytearray(good)
        bad[position] ^= 1 << (position % 8)
        path.write_bytes(bad)
        with pytest.raises(DataError) as caught:
            load_checkpoint(path)
        assert str(path) in caught.value.message and "\n" not in caught.value.message


def test_every_truncation_is_noticed(path: Path) -> None:
    good = path.read_bytes()
    for length in [*range(30), *range(30, len(good), 37), len(good) - 1]:
        path.write_bytes(good[:length])
        with pytest.raises(DataError, match="damaged"):
            load_checkpoint(path)
    path.write_bytes(good + b"x")
    with pytest.raises(DataError, match="damaged"):
        load_checkpoint(path)


@given(data=st.data())
def test_arbitrary_damage_never_gives_a_traceback(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    file = tmp_path_factory.getbasetemp() / "fuzz.safetensors"
    save_checkpoint(file, TENSORS, METADATA)
    good = file.read_bytes()
    for _ in range(data.draw(st.integers(1, 3))):
        start = data.draw(st.integers(0, len(good)))
        stop = start + data.draw(st.integers(0, 40))
        good = good[:start] + data.draw(st.binary(max_size=40)) + good[stop:]
    file.write_bytes(good)
    try:
        load_checkpoint(file)
    except HjepaError as error:
        assert error.exit_code == 65


@pytest.mark.parametrize(
    "header",
    [
        b"[]",
        b"{}",
        b'{"__metadata__":[]}',
        b'{"__metadata__":{"hjepa":3}}',
        b'{"a":3}',
        b'{"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}',
        b'{"a":{"dtype":"BF16","shape":[2],"data_offsets":[0,4]}}',
        b'{"a":{"dtype":"F32","shape":[-1],"data_offsets":[0,4]}}',
        b'{"a":{"dtype":"F32","shape":[99999999999999999999],"data_offsets":[0,4]}}',
        b'{"a":{"dtype":[],"shape":[1],"data_offsets":[0,4]}}',
        b'{"a":' * 100_000,
    ],
)
def test_foreign_headers_are_refused(tmp_path: Path, header: bytes) -> None:
    (tmp_path / "a").write_bytes(struct.pack("<Q", len(header)) + header + bytes(4))
    with pytest.raises(DataError):
        load_checkpoint(tmp_path / "a")


def test_other_dtypes_are_refused(tmp_path: Path) -> None:
    data = safetensors_numpy.save({"a": np.zeros(2)}, {"hjepa": '{"schema":1,"sha256":""}'})
    (tmp_path / "a").write_bytes(data)
    with pytest.raises(DataError, match="unexpected dtype F64"):
        load_checkpoint(tmp_path / "a")


def test_a_huge_header_is_not_even_read(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(struct.pack("<Q", 2**62) + b"{}")
    with pytest.raises(DataError, match="header is longer"):
        load_checkpoint(tmp_path / "a")


def test_what_could_not_be_read_again_is_not_written(path: Path) -> None:
    good = path.read_bytes()
    with pytest.raises(ValueError, match="readers accept 1048576"):
        save_checkpoint(path, TENSORS, {"text": "x" * 2**20})
    assert path.read_bytes() == good
    large = struct.pack("<Q", 2**20 + 8) + b"[" + b"0," * 2**19 + b"0]     "
    path.write_bytes(large)
    tracemalloc.start()
    with pytest.raises(DataError, match="header is longer"):
        load_checkpoint(path)
    assert tracemalloc.get_traced_memory()[1] < 2 * len(large)
    tracemalloc.stop()


def test_tampered_metadata_is_refused(path: Path) -> None:
    good = path.read_bytes()
    assert good.count(b'\\"h\\":4') == 1
    path.write_bytes(good.replace(b'\\"h\\":4', b'\\"h\\":8'))
    with pytest.raises(DataError, match="changed after it was written"):
        load_checkpoint(path)


def test_renamed_tensors_are_refused(path: Path) -> None:
    """The digest covers names: swapping two tensors of one shape is tampering."""
    good = path.read_bytes()
    path.write_bytes(good.replace(b'"frame_mean"', b'"frame_meen"'))
    with pytest.raises(DataError, match="changed after it was written"):
        load_checkpoint(path)


@pytest.mark.parametrize(
    ("schema", "match", "hint"),
    [
        (SCHEMA + 1, f"schema {SCHEMA + 1}; this hjepa reads up to {SCHEMA}", "upgrade"),
        (None, "schema None", None),
        ("1", "schema '1'", None),
        (True, "schema True", None),
        (0, "schema 0", None),
    ],
)
def test_other_schemas_are_refused(path: Path, schema: Any, match: str, hint: str | None) -> None:
    rewrite(path, TENSORS, {"schema": schema})
    with pytest.raises(DataError, match=match) as caught:
        load_checkpoint(path)
    assert (hint or "") in (caught.value.hint or "")


def test_rewrite_helper_makes_valid_checkpoints(path: Path) -> None:
    """Else the two tests around this one would pass for the wrong reason."""
    rewrite(path, TENSORS, {"note": "mine"})
    assert load_checkpoint(path).metadata == {"note": "mine"}


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_neither_written_nor_read(path: Path, value: float) -> None:
    good = path.read_bytes()
    bad = {"a": np.array([1, value], np.float32)}
    with pytest.raises(NumericalError, match="'a' is not finite"):
        save_checkpoint(path, bad, {})
    with pytest.raises(NumericalError):
        save_checkpoint(path, TENSORS, {"loss": value})
    assert path.read_bytes() == good and os.listdir(path.parent) == [path.name]
    rewrite(path, bad, {})
    with pytest.raises(DataError, match="'a' is not finite"):
        load_checkpoint(path)


def test_programming_errors_are_loud(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'a' is float64"):
        save_checkpoint(tmp_path / "a", {"a": np.zeros(2)}, {})
    with pytest.raises(ValueError, match="reserved"):
        save_checkpoint(tmp_path / "a", TENSORS, {"schema": 3})
    assert os.listdir(tmp_path) == []


def test_missing_foreign_and_lfs_files_say_so(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match="does not exist"):
        load_checkpoint(tmp_path / "gone")
    with pytest.raises(DataError, match="not a regular file"):
        load_checkpoint(tmp_path)
    (tmp_path / "plain").write_bytes(safetensors_numpy.save(TENSORS))
    with pytest.raises(DataError, match="not an hjepa checkpoint"):
        load_checkpoint(tmp_path / "plain")
    (tmp_path / "lfs").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\n")
    with pytest.raises(DataError, match="git-lfs pointer"):
        load_checkpoint(tmp_path / "lfs")


def test_check_tensors_names_the_first_difference(path: Path) -> None:
    checkpoint = load_checkpoint(path)
    expected: dict[str, tuple[str, tuple[int, ...]]] = {
        "encoder.weight": ("float32", (3, 100)),
        "encoder.batches": ("int64", ()),
        "frame_mean": ("float32", (5,)),
    }
    check_tensors(checkpoint, expected)
    for change, match in [
        ({"frame_std": ("float32", (5,))}, "'frame_std' is missing"),
        ({"frame_mean": ("int64", (5,))}, r"'frame_mean' is float32 \(5,\); expected int64"),
        ({"encoder.batches": ("int64", (1,))}, r"'encoder.batches' is int64 \(\)"),
    ]:
        with pytest.raises(DataError, match=match):
            check_tensors(checkpoint, expected | change)  # type: ignore[operator]
    del expected["frame_mean"]
    with pytest.raises(DataError, match="'frame_mean' is unexpected"):
        check_tensors(checkpoint, expected)


def test_a_dimension_beyond_all_numbers_is_refused(tmp_path: Path) -> None:
    """No bytes at all, so that safetensors itself has no objection."""
    header = b'{"a":{"dtype":"F32","shape":[0,9223372036854775808],"data_offsets":[0,0]}}'
    (tmp_path / "a").write_bytes(struct.pack("<Q", len(header)) + header)
    with pytest.raises(DataError, match="damaged"):
        load_checkpoint(tmp_path / "a")
