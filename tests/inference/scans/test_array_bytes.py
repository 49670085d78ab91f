"""Arrays from bytes: as numpy reads them, and nothing else gets through."""

from __future__ import annotations

import io
import pickle
import struct
import time
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as nps
from numpy.typing import NDArray

from attentionvote.inference.scans.array_bytes import array_from_npy, arrays_from_npz
from attentionvote.inference.scans.limits import Budget

MIB = 1024 * 1024


def npy(array: NDArray, version: tuple[int, int] | None = None) -> bytes:
    """A .npy file by numpy."""
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, version=version, allow_pickle=True)
    return stream.getvalue()


def npz(**arrays: NDArray) -> bytes:
    """A .npz file by numpy."""
    stream = io.BytesIO()
    np.savez(stream, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


@given(
    nps.arrays(
        st.sampled_from(["<f4", ">f4", "<f8", "u1", "<u2", "<i8", "f2"]),
        nps.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=5),
    ),
    st.sampled_from([(1, 0), (2, 0), (3, 0)]),
    st.booleans(),
)
def test_numbers_are_read_as_numpy_reads_them(array: NDArray, version: tuple[int, int], fortran: bool) -> None:
    array = np.asfortranarray(array) if fortran and array.ndim else array
    content = npy(array, version)
    ours, theirs = array_from_npy(content), np.load(io.BytesIO(content))
    assert ours.dtype == theirs.dtype
    np.testing.assert_array_equal(ours, theirs, strict=True)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.array([{}], object), "does not describe an array of plain numbers"),
        (np.array(["text"]), "does not describe"),
        (np.array([1j]), "does not describe"),
        (np.zeros(2, dtype=[("a", [("b", "f4")])]), "does not describe"),
        (np.zeros(2, dtype=[("a", "c8")]), "does not describe"),
        (np.zeros(2, dtype=[("a", "O")]), "does not describe"),
        (np.zeros(2, dtype=[(f"a{i}", "f4") for i in range(257)]), "does not describe|is damaged"),
    ],
)
def test_other_arrays_are_refused(array: NDArray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        array_from_npy(npy(array))


@pytest.mark.parametrize(
    "fields",
    [
        [("x", "<f4"), ("y", "<f4"), ("z", "<f4")],
        [("X", ">f8"), ("rgb", "u1", (3,)), ("Y", "f4"), ("name", "S5"), ("Z", "f2"), ("label", "U3")],
        {"names": ["x", "y", "z"], "formats": ["f4", "f4", "f4"], "offsets": [0, 4, 8], "itemsize": 32},
        {"names": ["y", "t"], "formats": ["f8", "u8"], "offsets": [8, 24], "itemsize": 48},
    ],
)
def test_records_are_read_as_numpy_reads_them(fields: Any) -> None:
    dtype = np.dtype(fields)
    array = np.frombuffer(np.random.default_rng(0).bytes(24 * dtype.itemsize), dtype).reshape(4, 6)
    array = array.copy()
    for name in dtype.names or ():
        if dtype[name].base.kind == "U":
            array[name] = "ab"
    ours, theirs = array_from_npy(npy(array)), np.load(io.BytesIO(npy(array)))
    assert ours.shape == theirs.shape
    assert ours.dtype.itemsize == dtype.itemsize
    for name in dtype.names or ():
        assert ours[name].tobytes() == theirs[name].tobytes()


def test_a_pickle_is_not_executed() -> None:
    class Bomb:
        def __reduce__(self) -> tuple:
            return (pytest.fail, ("the pickle was executed",))

    for content in (pickle.dumps(Bomb()), npy(np.array([Bomb()], object))):
        with pytest.raises(ValueError, match=r"no \.npy header|does not describe"):
            array_from_npy(content)


def test_truncated_and_longer_files_are_told_apart() -> None:
    content = npy(np.zeros((4, 3), np.float32))
    with pytest.raises(ValueError, match=r"shape \(4, 3\) of float32 needs 48 bytes, got 47: it is truncated"):
        array_from_npy(content[:-1])
    with pytest.raises(ValueError, match="got 49: something follows them"):
        array_from_npy(content + b"x")


def lying(header: bytes) -> bytes:
    """A .npy file of 12 bytes of data with any header."""
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(12)


@pytest.mark.parametrize(
    "header",
    [
        b"{'descr': '<f4', 'fortran_order': False, 'shape': (4000000000, 4000000000), }",
        b"{'descr': '<f4', 'fortran_order': False, 'shape': (99999999999999, 3), }",
        b"{'descr': '<f4', 'fortran_order': False, 'shape': (-1, 3), }",
        b"{'descr': '<f4', 'fortran_order': False, 'shape': (1, , 3), }",
        b"{'descr': '<f4', 'fortran_order': False, 'shape': (" + b"1," * 80 + b"), }",
        b"{'descr': [('x', '<f4', (99999,)), ], 'fortran_order': False, 'shape': (1, 3), }",
        b"{'descr': [('x', '<f4'), ('x', '<f4'), ], 'fortran_order': False, 'shape': (1, 3), }",
        b"{'descr': [('x', 'V9999')" + b", ('y', 'U9999')" * 9 + b"], 'fortran_order': False, 'shape': (1, 3), }",
        b"{'descr': [], 'fortran_order': False, 'shape': (1, 3), }",
        b"{'descr': [" + b"('x', " * 500 + b"], 'fortran_order': False, 'shape': (1, 3), }",
        b"{'descr': '<f5', 'fortran_order': False, 'shape': (1, 3), }",
        b"{'descr': '<f4', 'fortran_order': __import__('os').abort(), 'shape': (1, 3), }",
        b"",
        b"{}",
    ],
)
def test_a_lying_header_reserves_no_memory(header: bytes) -> None:
    content = lying(header)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match="its"):
            array_from_npy(content)
        assert tracemalloc.get_traced_memory()[1] < MIB
    finally:
        tracemalloc.stop()


def test_an_archive_is_read_by_name() -> None:
    arrays = arrays_from_npz(npz(a=np.arange(3), b=np.eye(2)), Budget(MIB))
    assert sorted(arrays) == ["a", "b"]
    np.testing.assert_array_equal(arrays["b"], np.eye(2))


def test_a_packed_archive_that_grows_beyond_the_bound_is_stopped() -> None:
    stream = io.BytesIO()
    np.savez_compressed(stream, a=np.zeros(100 * MIB, np.uint8))
    assert len(stream.getvalue()) < MIB
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match="it must unpack to at most 1048576 bytes, got more: crop or thin it out"):
            arrays_from_npz(stream.getvalue(), Budget(MIB))
        assert tracemalloc.get_traced_memory()[1] < 8 * MIB
    finally:
        tracemalloc.stop()


def test_many_members_and_damage_are_refused() -> None:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for i in range(40):
            archive.writestr(f"{i}.npy", npy(np.zeros(1)))
    with pytest.raises(ValueError, match="at most 32 arrays, got 40"):
        arrays_from_npz(stream.getvalue(), Budget(MIB))
    whole = npz(a=np.arange(100))
    for content in (b"", b"PK", whole[:200], whole[:-10], whole[:100] + b"\xff" * 50 + whole[150:]):
        with pytest.raises(ValueError, match=r"no \.npz archive, or damaged"):
            arrays_from_npz(content, Budget(MIB))


def edited(whole: bytes, magic: bytes, offset: int, layout: str, value: int) -> bytes:
    """An archive with one number of its first header of a kind replaced."""
    at = whole.index(magic) + offset
    return whole[:at] + struct.pack(layout, value) + whole[at + struct.calcsize(layout) :]


DIRECTORY, END = b"PK\x01\x02", b"PK\x05\x06"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda whole: edited(whole, DIRECTORY, 8, "<H", 1), "must not be encrypted: write it with numpy.savez"),
        (lambda whole: edited(whole, DIRECTORY, 10, "<H", 14), "must be stored or deflated, got LZMA: write it with"),
        (lambda whole: edited(whole, DIRECTORY, 10, "<H", 12), "must be stored or deflated, got bzip2"),
        (lambda whole: edited(whole, DIRECTORY, 10, "<H", 77), "must be stored or deflated, got another method"),
        (lambda whole: edited(whole, DIRECTORY, 16, "<I", 77), "or damaged"),
        (lambda whole: edited(whole, DIRECTORY, 20, "<I", 2**31), "or damaged"),
        (lambda whole: edited(whole, DIRECTORY, 24, "<I", 900), "or damaged"),
        (lambda whole: edited(whole, DIRECTORY, 24, "<I", 2**32 - 1), "or damaged"),
        (lambda whole: edited(whole, DIRECTORY, 28, "<H", 2000), "or damaged"),
        (lambda whole: edited(whole, DIRECTORY, 42, "<I", 2**32 - 1), "or damaged"),
        (
            lambda whole: edited(whole, END, 8, "<I", 0xFFFFFFFF),
            "got one of the 64-bit kind: write it with numpy.savez",
        ),
        (lambda whole: edited(whole, END, 16, "<I", 5), "or damaged"),
        (
            lambda whole: whole[: whole.index(END)] + b"PK\x06\x07" + bytes(16) + whole[whole.index(END) :],
            "64-bit kind",
        ),
        (lambda whole: whole.replace(b"b.npy", b"a.npy"), "must hold each array once, got 'a.npy' twice"),
    ],
)
@pytest.mark.parametrize("write", [np.savez, np.savez_compressed])
def test_an_odd_archive_is_one_sentence(write: Callable, change: Callable[[bytes], bytes], message: str) -> None:
    stream = io.BytesIO()
    write(stream, a=np.arange(100.0), b=np.zeros(2))
    with pytest.raises(ValueError, match=message):
        arrays_from_npz(change(stream.getvalue()), Budget(MIB))


@pytest.mark.parametrize("packing", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_packings_that_unpack_without_limit_are_not_unpacked(packing: int) -> None:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", packing) as archive:
        archive.writestr("points.npy", npy(np.zeros(20 * MIB, np.uint8)))
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match="must be stored or deflated"):
            arrays_from_npz(stream.getvalue(), Budget())
        assert tracemalloc.get_traced_memory()[1] < MIB
    finally:
        tracemalloc.stop()


def test_a_directory_is_measured_before_it_is_read() -> None:
    entry = DIRECTORY + struct.pack("<6H3I5H2I", *([20, 20] + [0] * 14))
    entries = 60_000
    end = struct.pack("<4s4H2IH", END, 0, 0, entries, entries, entries * len(entry), 30, 0)
    content = b"PK\x03\x04" + bytes(26) + entry * entries + end
    start = time.thread_time()
    with pytest.raises(ValueError, match="at most 32 arrays, got 60000"):
        arrays_from_npz(content, Budget())
    assert time.thread_time() - start < 0.02


def test_what_lies_behind_the_packed_data_or_before_their_end_is_damage() -> None:
    data = npy(np.arange(64.0))
    for packed, size in (
        (zlib.compress(data, wbits=-15)[:-4], len(data)),
        (zlib.compress(data + bytes(9), wbits=-15), len(data)),
        (zlib.compress(data[:-9], wbits=-15), len(data)),
        (b"\xff" * 200, len(data)),
    ):
        local = struct.pack("<4s5H3I2H", b"PK\x03\x04", 20, 0, 8, 0, 0, 0, 0, 0, 5, 0) + b"a.npy" + packed
        entry = struct.pack(
            "<4s6H3I5H2I", DIRECTORY, 20, 20, 0, 8, 0, 0, zlib.crc32(data), len(packed), size, 5, 0, 0, 0, 0, 0, 0
        )
        end = struct.pack("<4s4H2IH", END, 0, 0, 1, 1, len(entry) + 5, len(local), 0)
        with pytest.raises(ValueError, match="or damaged"):
            arrays_from_npz(local + entry + b"a.npy" + end, Budget(MIB))


@given(st.data())
def test_no_damaged_archive_raises_anything_else(data: st.DataObject) -> None:
    whole = bytearray(npz(points=np.arange(12.0).reshape(4, 3)))
    for _ in range(data.draw(st.integers(1, 5))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    with suppress(ValueError):
        arrays_from_npz(bytes(whole), Budget(MIB))
