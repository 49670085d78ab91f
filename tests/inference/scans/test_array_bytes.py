"""Arrays from bytes: as numpy reads them, and nothing else gets through."""

from __future__ import annotations

import io
import pickle
import tracemalloc
import zipfile
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as nps
from numpy.typing import NDArray

from attentionvote.inference.scans.array_bytes import array_from_npy, arrays_from_npz

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
    ours, theirs = array_from_npy(content, MIB), np.load(io.BytesIO(content))
    assert ours.dtype == theirs.dtype
    np.testing.assert_array_equal(ours, theirs, strict=True)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.array([{}], object), "does not describe an array of plain numbers"),
        (np.array(["text"]), "does not describe"),
        (np.array([1j]), "does not describe"),
        (np.array([(1, 2.0)], dtype=[("a", "i4"), ("b", "f4")]), "does not describe"),
        (np.zeros((1024, 1024, 2), np.uint8), "must have at most 1048576 bytes"),
    ],
)
def test_other_arrays_are_refused(array: NDArray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        array_from_npy(npy(array), MIB)


def test_a_pickle_is_not_executed() -> None:
    class Bomb:
        def __reduce__(self) -> tuple:
            return (pytest.fail, ("the pickle was executed",))

    for content in (pickle.dumps(Bomb()), npy(np.array([Bomb()], object))):
        with pytest.raises(ValueError, match=r"no \.npy header|does not describe"):
            array_from_npy(content, MIB)


def test_truncated_and_longer_files_are_told_apart() -> None:
    content = npy(np.zeros((4, 3), np.float32))
    with pytest.raises(ValueError, match=r"shape \(4, 3\) of float32 needs 48 bytes, got 47: it is truncated"):
        array_from_npy(content[:-1], MIB)
    with pytest.raises(ValueError, match="got 49: something follows them"):
        array_from_npy(content + b"x", MIB)


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
            array_from_npy(content, 100 * MIB)
        assert tracemalloc.get_traced_memory()[1] < MIB
    finally:
        tracemalloc.stop()


def test_an_archive_is_read_by_name() -> None:
    arrays = arrays_from_npz(npz(a=np.arange(3), b=np.eye(2)), MIB)
    assert sorted(arrays) == ["a", "b"]
    np.testing.assert_array_equal(arrays["b"], np.eye(2))


def test_a_packed_archive_that_grows_beyond_the_bound_is_stopped() -> None:
    stream = io.BytesIO()
    np.savez_compressed(stream, a=np.zeros(100 * MIB, np.uint8))
    assert len(stream.getvalue()) < MIB
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match="must have at most 1048576 bytes"):
            arrays_from_npz(stream.getvalue(), MIB)
        assert tracemalloc.get_traced_memory()[1] < 8 * MIB
    finally:
        tracemalloc.stop()


def test_many_members_and_damage_are_refused() -> None:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for i in range(40):
            archive.writestr(f"{i}.npy", npy(np.zeros(1)))
    with pytest.raises(ValueError, match="at most 32 arrays, got 40"):
        arrays_from_npz(stream.getvalue(), MIB)
    whole = npz(a=np.arange(100))
    for content in (b"", b"PK", whole[:200], whole[:-10], whole[:100] + b"\xff" * 50 + whole[150:]):
        with pytest.raises(ValueError, match=r"no \.npz archive, or damaged"):
            arrays_from_npz(content, MIB)


@given(st.data())
def test_no_damaged_archive_raises_anything_else(data: st.DataObject) -> None:
    whole = bytearray(npz(points=np.arange(12.0).reshape(4, 3)))
    for _ in range(data.draw(st.integers(1, 5))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    with suppress(ValueError):
        arrays_from_npz(bytes(whole), MIB)
