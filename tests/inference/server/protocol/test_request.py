"""The request parser: what it reads, what it refuses and with which sentence, and that nothing breaks it."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from attentionvote.inference.errors import InputError
from attentionvote.inference.server.protocol.request import InferRequest, parse_request

CLOUD = np.arange(12, dtype=np.float32).reshape(4, 3)


def request(points: np.ndarray = CLOUD, *, binary: bool = True, **changes: Any) -> tuple[bytes, str | None]:
    """Body and header of a request; ``tensor`` changes the input, other names the request itself."""
    raw = points.astype("<f4").tobytes() if binary else b""
    tensor: dict[str, Any] = {"name": "points", "datatype": "FP32", "shape": list(points.shape)}
    tensor |= {"parameters": {"binary_data_size": len(raw)}} if binary else {"data": points.reshape(-1).tolist()}
    tensor |= changes.pop("tensor", {})
    head = json.dumps({"inputs": [tensor], **changes}).encode()
    return head + raw, str(len(head)) if binary else None


@settings(max_examples=40)
@given(arrays(np.float32, st.tuples(st.integers(0, 50), st.just(3)), elements=st.floats(-1e6, 1e6, width=32)))
def test_binary_and_json_carry_the_same_points_exactly(points: np.ndarray) -> None:
    for binary in (True, False):
        np.testing.assert_array_equal(parse_request(*request(points, binary=binary)).points, points)


def test_rows_are_as_good_as_a_flat_list() -> None:
    flat = parse_request(*request(binary=False)).points
    rows = parse_request(*request(binary=False, tensor={"data": CLOUD.tolist()})).points
    np.testing.assert_array_equal(flat, rows)


def test_points_are_float32_and_small_ones_survive() -> None:
    asked = parse_request(*request(binary=False, tensor={"shape": [1, 3], "data": [1, 2.5, 1e-30]}))
    assert asked.points.dtype == np.float32
    np.testing.assert_array_equal(asked.points, np.array([[1, 2.5, 1e-30]], np.float32))


def test_outputs_default_to_all_as_json() -> None:
    asked = parse_request(*request())
    assert [tuple(output) for output in asked.outputs] == [
        ("camera_from_part", False), ("confidence", False), ("heat", False), ("class_index", False), ("part", False),
    ]  # fmt: skip
    assert asked.id == ""
    assert asked.deadline_ms is None


def test_binary_outputs_by_request_and_by_output() -> None:
    everything = parse_request(*request(parameters={"binary_data_output": True}))
    assert all(output.binary for output in everything.outputs)
    outputs = [{"name": "heat"}, {"name": "confidence", "parameters": {"binary_data": False}}]
    asked = parse_request(*request(parameters={"binary_data_output": True}, outputs=outputs))
    assert [tuple(output) for output in asked.outputs] == [("heat", True), ("confidence", False)]


def test_id_and_deadline_are_read() -> None:
    asked = parse_request(*request(id="scan-7", parameters={"deadline_ms": 250}))
    assert (asked.id, asked.deadline_ms) == ("scan-7", 250.0)
    assert parse_request(*request(parameters={"timeout": 1_500_000})).deadline_ms == 1500.0  # Triton's microseconds


def test_an_empty_cloud_is_a_request() -> None:
    empty = np.zeros((0, 3), np.float32)
    for binary in (True, False):
        assert parse_request(*request(empty, binary=binary)).points.shape == (0, 3)


def test_nan_passes_the_parser_in_binary_but_not_in_json() -> None:
    points = np.full((1, 3), np.nan, np.float32)
    assert np.isnan(parse_request(*request(points)).points).all()  # the estimator counts and names them
    with pytest.raises(InputError, match="numbers must be finite, got NaN"):
        parse_request(*request(points, binary=False))


REFUSED: list[tuple[str, dict[str, Any], str]] = [
    ("name", {"tensor": {"name": "point"}}, "must be named 'points', got 'point', did you mean 'points'"),
    ("datatype", {"tensor": {"datatype": "FP64"}}, "must have datatype FP32, got 'FP64'"),
    ("shape of 6", {"tensor": {"shape": [2, 6]}}, r"must have shape \[P, 3\] with P >= 0, got \[2, 6\]"),
    ("batch", {"tensor": {"shape": [1, 4, 3]}}, r"must have shape \[P, 3\]"),
    ("negative", {"tensor": {"shape": [-4, 3]}}, r"must have shape \[P, 3\]"),
    ("fraction", {"tensor": {"shape": [4.0, 3]}}, r"must have shape \[P, 3\]"),
    ("truth", {"tensor": {"shape": [True, 3]}}, r"must have shape \[P, 3\]"),
    ("huge shape", {"tensor": {"shape": [10**300, 3]}}, r"must have shape \[P, 3\] with P >= 0, got"),
    ("size", {"tensor": {"parameters": {"binary_data_size": 47}}}, "must be 48 bytes .* got 47"),
    ("size text", {"tensor": {"parameters": {"binary_data_size": "48"}}}, "must be 48 bytes .* got '48'"),
    ("both", {"tensor": {"data": [1]}}, "must have data or binary_data_size, got both"),
    ("no size", {"tensor": {"parameters": {}}}, "must have parameter binary_data_size .* got none and 48 bytes"),
    ("shared", {"tensor": {"parameters": {"shared_memory_region": "x"}}}, "got shared_memory_region"),
    ("parameters", {"parameters": [1]}, "parameters must be a JSON object, got a list"),
    ("no inputs", {"inputs": []}, "exactly one input, 'points' FP32 .* got 0 inputs"),
    ("inputs", {"inputs": {}}, "got inputs of type an object"),
    ("input", {"inputs": [7]}, "an input must be a JSON object, got a number"),
    ("output", {"outputs": [{"name": "heath"}]}, "must be one of camera_from_part, .* did you mean 'heat'"),
    ("twice", {"outputs": [{"name": "heat"}] * 2}, "asked for once, got 'heat' twice"),
    ("outputs", {"outputs": [{}] * 9}, "list of at most 5"),
    ("flag", {"parameters": {"binary_data_output": 1}}, "must be true or false, got 1"),
    ("deadline", {"parameters": {"deadline_ms": -1}}, "deadline_ms must be a positive number of milliseconds, got -1"),
    ("timeout", {"parameters": {"timeout": "1"}}, "timeout must be a positive number of microseconds, got '1'"),
    ("id", {"id": 7}, "id must be a text of at most 256 characters, got 7"),
]


@pytest.mark.parametrize(("changes", "sentence"), [r[1:] for r in REFUSED], ids=[r[0] for r in REFUSED])
def test_refused_with_rule_and_actual(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        parse_request(*request(**changes))


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        ([1, 2, 3], "must hold 12 numbers for shape .4, 3., got 3"),
        ([[1, 2, 3]], "must be 4 rows of 3 numbers"),
        ([[1, 2, 3], [1, 2, 3], [1, 2, 3], [1, 2]], "must be 4 rows of 3 numbers"),
        (["1"] * 12, "must be numbers, flat or in rows of 3, got other values"),
        ([True] * 12, "must be numbers, flat or in rows of 3, got other values"),
        ([None] * 12, "must be numbers, flat or in rows of 3, got other values"),
        ([[[0.0]] * 3] * 4, "must be numbers, flat or in rows of 3, got other values"),
        ([1, 2, [3]] * 4, "must be numbers, flat or in rows of 3, got other values"),
        ([10**400] * 12, "must be numbers within float32, got a huge number"),
        ("0 0 0", "must have data, a list, or binary_data_size, got a text"),
    ],
)
def test_json_data_that_are_no_points(data: Any, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        parse_request(*request(binary=False, tensor={"data": data}))


def test_truncated_and_overlong_bodies() -> None:
    body, header = request()
    with pytest.raises(InputError, match="must have 48 bytes after the JSON, got 47: was the body truncated"):
        parse_request(body[:-1], header)
    with pytest.raises(InputError, match=r"must have 48 bytes after the JSON, got 49$"):
        parse_request(body + b"x", header)
    with pytest.raises(InputError, match="must be at most the body's 20 bytes, got"):
        parse_request(body[:20], header)
    with pytest.raises(InputError, match="must be JSON in UTF-8"):
        parse_request(body, None)  # the header was forgotten


@pytest.mark.parametrize("header", ["-1", "+5", "1_0", "٣", "", " 5", "1e3", "9" * 40])
def test_a_header_that_is_no_length(header: str) -> None:
    with pytest.raises(InputError, match="Inference-Header-Content-Length must be a whole number of bytes, got"):
        parse_request(request()[0], header)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)
names = ("name", "datatype", "shape", "data", "parameters")


@st.composite
def bodies(draw: st.DrawFn) -> tuple[bytes, str | None]:
    """Requests that are right but for a few places, and some noise."""
    kind = draw(st.sampled_from(["noise", "json", "tensor", "bytes"]))
    if kind == "noise":
        return draw(st.binary(max_size=200)), draw(st.none() | st.integers(-5, 300).map(str) | st.text(max_size=5))
    if kind == "json":
        return json.dumps(draw(json_values)).encode(), None
    changes = {name: draw(json_values) for name in draw(st.sets(st.sampled_from(names), max_size=2))}
    request_changes = draw(st.dictionaries(st.sampled_from(["id", "parameters", "outputs", "inputs"]), json_values))
    body, header = request(binary=draw(st.booleans()), tensor=changes, **request_changes)
    if kind == "bytes" and body:
        at = draw(st.integers(0, len(body) - 1))
        body = body[:at] + draw(st.binary(max_size=4)) + body[at + draw(st.integers(0, 4)) :]
    return body, header


@settings(max_examples=150)
@given(bodies())
@example((b"[" * 100_000, None))
@example((b'{"a":' * 50_000 + b"1" + b"}" * 50_000, None))
@example((b'"' + b"[" * 1000 + b'"', None))
@example((b"1" * 10_000, None))
@example((b"\xff\xfe", None))
@example((b"", None))
@example((b'{"inputs": [], "inputs": [{}]}', "30"))
def test_any_input_gives_a_request_or_one_sentence(given_request: tuple[bytes, str | None]) -> None:
    check_parsed(*given_request)


def test_thousands_of_damaged_requests_give_a_request_or_one_sentence() -> None:
    rng = np.random.default_rng(0)
    alphabet = np.frombuffer(b'{}[]",:0123456789.eE+-\\tfn \x00\xff', np.uint8)
    refused = 0
    for _ in range(5000):
        body, header = request(binary=bool(rng.integers(2)), outputs=[{"name": "heat"}], id="x")
        damaged = bytearray(body)
        for _ in range(rng.integers(1, 4)):
            at = int(rng.integers(len(damaged)))
            new = bytes(rng.choice(alphabet, rng.integers(0, 3)))
            damaged[at : at + int(rng.integers(0, 3))] = new
        refused += not check_parsed(bytes(damaged), header)
    assert 2000 < refused < 5000  # damaged, but not all beyond recognition


def check_parsed(body: bytes, header: str | None) -> bool:
    """Whether it is a request; if not, that it is refused in one sentence."""
    try:
        asked = parse_request(body, header)
    except InputError as error:
        sentence = str(error)
        assert 10 < len(sentence) < 600
        assert "\n" not in sentence
        return False
    assert isinstance(asked, InferRequest)
    assert asked.points.dtype == np.float32
    assert asked.points.ndim == 2
    assert asked.points.shape[1] == 3
    assert len(asked.outputs) <= 5
    return True
