"""Rows of numbers: the compiled code and Python agree with float(), bit by bit, on every text."""

from __future__ import annotations

import ctypes
import math
import time
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from attentionvote.geometry import native
from attentionvote.inference.scans import number_rows
from attentionvote.inference.scans.limits import Budget
from attentionvote.inference.scans.number_rows import RowLayout, all_number_rows

XYZ = RowLayout(3, [0, 1, 2])


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    """The compiled code."""
    library = native.load("attentionvote.inference.scans", "scan_bytes.c")
    assert library is not None
    return library


def by_c(library: ctypes.CDLL, text: bytes, layout: RowLayout = XYZ, count: int = 1000) -> tuple[object, int]:
    """Rows, or the sentence, and how many bytes were read."""
    return outcome(number_rows._RowsByC(library, memoryview(text), Budget()), layout, count)


def by_python(text: bytes, layout: RowLayout = XYZ, count: int = 1000) -> tuple[object, int]:
    """The same by the reference."""
    return outcome(number_rows._RowsByPython(memoryview(text), Budget()), layout, count)


def outcome(
    reader: number_rows._RowsByC | number_rows._RowsByPython, layout: RowLayout, count: int
) -> tuple[object, int]:
    """What a reader gives; of its NaN the sign does not matter."""
    rows = np.zeros((count, 3), np.float32)
    try:
        done = reader.read(count, layout, rows)
    except ValueError as error:
        return str(error), 0
    rows[np.isnan(rows)] = np.nan
    return (done, rows[:done].tobytes()), reader.at


def single(text: str) -> np.float32:
    """The number that a text means: float64, then float32."""
    with np.errstate(over="ignore"):
        return np.float32(np.float64(float(text)))


DIGITS = st.text("0123456789", max_size=24)
NUMBERS = st.one_of(
    st.builds(
        lambda sign, whole, point, part, exponent: sign + whole + point + part + exponent,
        st.sampled_from(["", "+", "-"]),
        DIGITS,
        st.sampled_from(["", "."]),
        DIGITS,
        st.one_of(st.just(""), st.integers(-60, 60).map("e{}".format), st.integers(-9, 9).map("E{:+03d}".format)),
    ),
    st.floats(width=32).map(repr),
    st.floats().map(lambda value: f"{value:.17g}"),
    st.floats(-10, 10).map(lambda value: f"{value:.6f}"),
    st.sampled_from(
        ["nan", "NaN", "-nan", "inf", "-Inf", "INFINITY", "+infinity", "infinit", "nano", "1_0", "0x1", "\u0661"]
    ),
)


@settings(max_examples=2000)
@given(NUMBERS)
@example("16777217")  # halfway between two float32
@example("0.50000002980232238769531250000000001")
@example("3.4028235677973366e38")  # halfway to infinity
@example("3.4028235677973365e38")
@example("7.006492321624085e-46")  # half the smallest float32
@example("1.1754943508222875e-38")
@example("-0.0")
@example("9" * 320)
@example("9" * 321)
@example("0." + "0" * 300 + "1")
@example("1e99999999999")
@example("00000000000000000000000000000000.1")
def test_a_number_is_rounded_as_python_rounds_it(text: str) -> None:
    library = native.load("attentionvote.inference.scans", "scan_bytes.c")
    assert library is not None
    row = f"{text} 1 2".encode()
    got = by_c(library, row)
    assert got == by_python(row)
    if isinstance(got[0], tuple) and got[0][0] == 1:
        value = np.frombuffer(got[0][1], np.float32)[0]
        expected = single(text)
        assert value.tobytes() == expected.tobytes() or (math.isnan(value) and math.isnan(expected))
    elif text.isascii() and len(text) <= 320 and "_" not in text and text:
        with pytest.raises(ValueError, match="could not convert"):
            float(text)


def test_a_hundred_thousand_numbers_near_ties_are_right(library: ctypes.CDLL) -> None:
    rng = np.random.default_rng(0)
    bits = rng.integers(0x30000000, 0x50000000, 30_000, dtype=np.uint32)
    low = bits.view(np.float32).astype(np.float64)
    ties = (low + np.nextafter(bits.view(np.float32), np.float32(np.inf)).astype(np.float64)) / 2
    texts = [f"{tie:.{digits}e}" for tie, digits in zip(ties, rng.integers(6, 40, len(ties)), strict=True)]
    rows = "\n".join(f"{text} 0.5 -1" for text in texts).encode()
    done, data = by_c(library, rows, count=len(texts))[0]  # type: ignore[misc]
    assert done == len(texts)
    np.testing.assert_array_equal(
        np.frombuffer(data, np.float32).reshape(-1, 3)[:, 0], np.array([single(text) for text in texts])
    )


PIECES = st.sampled_from(
    [
        "1",
        "-2.5",
        "3e2",
        " ",
        "\t",
        "\n",
        "\r",
        "\r\n",
        ",",
        ";",
        "nan",
        "x",
        ".",
        "1e",
        "\0",
        "\x0b",
        "\x0c",
        "é",
        "7 8 9\n",
    ]
)


@settings(max_examples=1500)
@given(
    st.lists(PIECES, max_size=30).map("".join),
    st.integers(1, 5),
    st.sampled_from([b"", b",", b";"]),
    st.permutations([0, 1, 2, 3]),
    st.integers(0, 8),
)
def test_both_ways_read_every_text_alike(text: str, width: int, mark: bytes, columns: list[int], count: int) -> None:
    library = native.load("attentionvote.inference.scans", "scan_bytes.c")
    assert library is not None
    layout = RowLayout(width, [column % width for column in columns[:3]], mark)
    content = text.encode()
    assert by_c(library, content, layout, count) == by_python(content, layout, count)
    readers = (
        number_rows._RowsByC(library, memoryview(content), Budget()),
        number_rows._RowsByPython(memoryview(content), Budget()),
    )
    skipped = [(reader.read(count, RowLayout(0, (-1, -1, -1)), None), reader.at) for reader in readers]
    assert skipped[0] == skipped[1]


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("size", [64 * 1024 - 1, 64 * 1024, 64 * 1024 + 1, 200_000])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_pieces_are_joined_where_lines_and_their_ends_are_cut(size: int, end: str) -> None:
    row = "0.25 -1.5 100" + end
    text = (row * (size // len(row) + 1)).encode()
    for cut in range(len(row)):
        rows = all_number_rows(memoryview(b" " * cut + text), XYZ, Budget(most_seconds=60))
        np.testing.assert_array_equal(rows, np.tile(np.float32([0.25, -1.5, 100]), (size // len(row) + 1, 1)))


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize(
    "text", [b"1 2 3\n" * 2_000_000, b"\n" * 9_000_000 + b"1 2 3", b"1 " * 6_000_000, b"7" * 9_000_000]
)
def test_no_text_takes_longer_than_its_budget(text: bytes) -> None:
    start = time.thread_time()
    with suppress(ValueError):
        all_number_rows(memoryview(text), XYZ, Budget(most_seconds=0.05))
    assert time.thread_time() - start < 0.6


def test_a_slow_text_is_told_what_to_send_instead() -> None:
    with (
        native.disabled(),
        pytest.raises(
            ValueError, match=r"within 0.01 s of processor time, .*: send a binary PLY or a .npy file instead"
        ),
    ):
        all_number_rows(memoryview(b"1 2 3\n" * 200_000), XYZ, Budget(most_seconds=0.01))


def test_a_million_points_are_read_in_time() -> None:
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(5000, 3))
    text = "\n".join(f"{x:.8f} {y:.7g} {z:.17g}" for x, y, z in rows.tolist()).encode() + b"\n"
    start = time.thread_time()
    read = all_number_rows(memoryview(text * 200), XYZ, Budget(most_seconds=60))
    assert time.thread_time() - start < 2  # 0.15 on an idle machine
    np.testing.assert_allclose(read[-5000:], rows, rtol=1e-6, atol=1e-8)
