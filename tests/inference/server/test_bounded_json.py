"""JSON from strangers: depth, size and values."""

from __future__ import annotations

import json
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.inference.errors import InputError
from attentionvote.inference.server.bounded_json import MOST_BYTES, MOST_DEPTH, parse_json

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(), inner, max_size=5),
    max_leaves=10,
)


@given(values)
def test_reads_what_json_reads(value: object) -> None:
    text = json.dumps(value).encode()
    if str(value).count("[") + str(value).count("{") <= MOST_DEPTH:
        assert parse_json("it", text) == value


def test_depth_counts_brackets_outside_texts_only() -> None:
    deep = b"[" * MOST_DEPTH + b"]" * MOST_DEPTH
    assert parse_json("it", deep)
    with pytest.raises(InputError, match=f"it must be JSON nested at most {MOST_DEPTH} deep, got {MOST_DEPTH + 1}"):
        parse_json("it", b"[" + deep + b"]")
    text = '"' + "[" * 100 + '\\"' + "{" * 100 + '"'
    assert parse_json("it", text.encode()) == json.loads(text)


@pytest.mark.parametrize("text", [b"NaN", b"[1, -Infinity]"])
def test_numbers_are_finite(text: bytes) -> None:
    with pytest.raises(InputError, match="numbers must be finite, got"):
        parse_json("it", text)


@pytest.mark.parametrize("text", [b"", b"{", b"{'a': 1}", b"\xff", b"1" * 5000, b'"\\', b'"' * 99])
def test_what_is_no_json_is_one_sentence(text: bytes) -> None:
    with pytest.raises(InputError, match="it must be JSON in UTF-8, got a text that is not") as caught:
        parse_json("it", text)
    assert len(str(caught.value)) < 200


def test_too_large_is_refused_before_it_is_read() -> None:
    with pytest.raises(InputError, match=f"at most {MOST_BYTES} bytes of JSON, got {MOST_BYTES + 1}: send the tensor"):
        parse_json("it", b" " * (MOST_BYTES + 1))


@pytest.mark.parametrize("piece", [b"[", b'"', b'\\"', b"0,"])
def test_the_largest_texts_take_seconds_at_most(piece: bytes) -> None:
    begun = time.process_time()
    with pytest.raises(InputError):
        parse_json("it", piece * (MOST_BYTES // len(piece)))
    assert time.process_time() - begun < 5
