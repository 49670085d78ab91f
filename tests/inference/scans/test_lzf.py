"""LZF against a slow reference, on packed data of every kind."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.geometry import native
from attentionvote.inference.scans import lzf
from attentionvote.inference.scans.limits import Budget
from attentionvote.inference.scans.lzf import decompressed

MIB = 1024 * 1024


pytestmark = pytest.mark.usefixtures("way")


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
    assert decompressed(bytes(packed), size, Budget()).tobytes() == expected
    assert decompressed(bytes(packed), size // 2, Budget()).tobytes() == expected[: size // 2]
    with pytest.raises(ValueError, match="end early"):
        decompressed(bytes(packed), size + 1, Budget())


@given(st.binary(max_size=60), st.integers(0, 5000))
def test_any_bytes_end_in_data_or_a_value_error(packed: bytes, size: int) -> None:
    try:
        assert len(decompressed(packed, size, Budget())) == size
    except ValueError as error:
        assert "compressed points" in str(error)  # noqa: PT017


def test_a_reference_before_the_beginning_is_damage() -> None:
    with pytest.raises(ValueError, match="damaged"):
        decompressed(bytes([0, 65, 0x20, 1]), 4, Budget())


def test_a_repeated_pattern_may_overlap_itself() -> None:
    assert decompressed(bytes([1, 65, 66, 0x60 | 0, 1]), 7, Budget()).tobytes() == b"ABABABA"


def test_both_ways_give_the_same_bytes_or_the_same_sentence() -> None:
    rng = np.random.default_rng(0)
    library = native.compiled("attentionvote.inference.scans", "scan_bytes.c", False)
    assert library is not None
    for _ in range(3000):
        packed, size = rng.integers(0, 256, rng.integers(0, 40), np.uint8).tobytes(), int(rng.integers(0, 400))
        if rng.random() < 0.7:
            packed = b"\x1f" + rng.bytes(32) + packed
        answers = []
        for way in (lambda *a: lzf._by_python(*a), lambda *a: lzf._by_c(library, *a).tobytes()):  # type: ignore[arg-type]
            try:
                answers.append(bytes(way(packed, size, Budget())))
            except ValueError as error:
                answers.append(str(error).encode())
        assert answers[0] == answers[1]


def test_slow_data_are_stopped_and_the_compiled_code_needs_no_stop(way: str) -> None:
    # The slowest tokens for Python: literals of one byte; and for the C code: repetitions of three.
    slow = bytes([0, 1]) * (8 * MIB) if way == "python" else bytes([2, 1, 2, 3]) + bytes([0x20, 2]) * (8 * MIB)
    start = time.thread_time()
    if way == "python":
        with pytest.raises(ValueError, match=r"must be read within 0.1 s of processor time, .*: send a binary PLY"):
            decompressed(slow, 8 * MIB, Budget(most_seconds=0.1))
        assert time.thread_time() - start < 0.6
    else:
        assert len(decompressed(slow, 24 * MIB, Budget(most_seconds=60))) == 24 * MIB


def test_the_clock_is_looked_at_while_the_compiled_code_runs(way: str) -> None:
    with pytest.raises(ValueError, match="must be read within 0 s of processor time"):
        decompressed(bytes([0, 1]) * 4096, 4096 if way == "python" else 10, Budget(most_seconds=0))


def test_a_promise_that_no_packed_data_can_keep_reserves_nothing() -> None:
    with pytest.raises(ValueError, match="end early"):
        decompressed(bytes(1000), 88_001, Budget())
    with pytest.raises(ValueError, match="must unpack to at most 1000 bytes"):
        decompressed(bytes(1000), 1001, Budget(1000))
