"""LZF against a slow reference, on packed data of every kind."""

from __future__ import annotations

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.inference.scans.lzf import decompressed


def reference(packed: bytes) -> bytes:
    """The format's description, byte by byte."""
    source, out = iter(packed), []
    for control in source:
        if control < 32:
            out += [next(source) for _ in range(control + 1)]
            continue
        count = control >> 5
        if count == 7:
            count += next(source)
        back = (control & 31) * 256 + next(source) + 1
        for _ in range(count + 2):
            out.append(out[-back])
    return bytes(out)


LITERAL = st.binary(min_size=1, max_size=32)
REPEAT = st.tuples(st.integers(1, 8192), st.integers(3, 264))


@given(LITERAL, st.lists(LITERAL | REPEAT, max_size=30))
def test_it_unpacks_as_the_format_says(first: bytes, tokens: list[bytes | tuple[int, int]]) -> None:
    packed, size = bytearray(), 0
    for token in [first, *tokens]:
        if isinstance(token, bytes):
            packed += bytes([len(token) - 1]) + token
            size += len(token)
        else:
            back, count = (token[0] - 1) % min(size, 8192), token[1] - 2
            upper = min(count, 7)
            packed.append(upper << 5 | back >> 8)
            if upper == 7:
                packed.append(count - 7)
            packed.append(back & 255)
            size += token[1]
    expected = reference(bytes(packed))
    assert len(expected) == size
    assert decompressed(bytes(packed), size) == expected
    assert decompressed(bytes(packed), size // 2) == expected[: size // 2]
    with pytest.raises(ValueError, match="end early"):
        decompressed(bytes(packed), size + 1)


@given(st.binary(max_size=60), st.integers(0, 5000))
def test_any_bytes_end_in_data_or_a_value_error(packed: bytes, size: int) -> None:
    try:
        assert len(decompressed(packed, size)) == size
    except ValueError as error:
        assert "compressed points" in str(error)  # noqa: PT017


def test_a_reference_before_the_beginning_is_damage() -> None:
    with pytest.raises(ValueError, match="damaged"):
        decompressed(bytes([0, 65, 0x20, 1]), 4)


def test_a_repeated_pattern_may_overlap_itself() -> None:
    assert decompressed(bytes([1, 65, 66, 0x60 | 0, 1]), 7) == b"ABABABA"


def test_a_megabyte_takes_less_than_seconds() -> None:
    # The slowest token that a reader of PCD files lets through unpacks three bytes.
    packed = bytes([2, 1, 2, 3]) + bytes([0x20, 2]) * 350_000
    start = time.process_time()
    assert len(decompressed(packed, 1_000_000)) == 1_000_000
    assert time.process_time() - start < 3
