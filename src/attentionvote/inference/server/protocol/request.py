"""An inference request of the Open Inference Protocol, from bytes to points. Pure: no network, no model.

Version 2, REST, with the binary tensor extension: the body is a JSON object, and when the header
``Inference-Header-Content-Length`` gives that object's length, the bytes after it are the tensors that have a
``binary_data_size``, in the order of the inputs.
"""

from __future__ import annotations

import itertools
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.inference.errors import InputError, nearest
from attentionvote.inference.server.bounded_json import parse_json

INPUT = "points"
LENGTH_HEADER = "Inference-Header-Content-Length"
OUTPUTS = {
    "camera_from_part": "FP64", "confidence": "FP32", "heat": "FP32", "class_index": "INT64", "part": "BYTES",
}  # fmt: skip
_MOST_ID = 256
_MOST_ROWS = 2**31
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxlist, _SHORT.maxdict, _SHORT.maxstring, _SHORT.maxlong = 2, 6, 3, 60, 24


class AskedOutput(NamedTuple):
    """An output the client wants, and whether as binary data."""

    name: str
    binary: bool


@dataclass(frozen=True)
class InferRequest:
    """What a client asks.

    Attributes:
        points: ``(P, 3)`` float32, metres, camera frame; P may be 0; not yet checked for NaN.
        id: to be repeated in the answer; empty when there was none.
        deadline_ms: of the parameters ``deadline_ms`` or ``timeout`` (microseconds, Triton's); None without.
        outputs: in the order of the answer.
    """

    points: NDArray[np.float32]
    id: str
    deadline_ms: float | None
    outputs: tuple[AskedOutput, ...]


def parse_request(body: bytes, header_length: str | None) -> InferRequest:
    """Read a request.

    Args:
        body: of the HTTP request.
        header_length: value of ``Inference-Header-Content-Length``; None without.

    Raises:
        InputError: with rule, expected and actual.
    """
    head, tail = _split(body, header_length)
    content = _object("the request", parse_json("the request", head))
    parameters = _object("parameters", content.get("parameters", {}))
    inputs = content.get("inputs")
    if not isinstance(inputs, list) or len(inputs) != 1:
        got = f"{len(inputs)} inputs" if isinstance(inputs, list) else f"inputs of type {_kind(inputs)}"
        raise InputError(f"the request must have exactly one input, {INPUT!r} FP32 [-1, 3], got {got}")
    points = _points(_object("an input", inputs[0]), tail)
    identity = content.get("id", "")
    if not isinstance(identity, str) or len(identity) > _MOST_ID:
        raise InputError(f"id must be a text of at most {_MOST_ID} characters, got {_short(identity)}")
    binary = _flag("parameter binary_data_output", parameters.get("binary_data_output", False))
    return InferRequest(points, identity, _deadline_ms(parameters), _outputs(content.get("outputs"), binary))


def _split(body: bytes, header_length: str | None) -> tuple[bytes, memoryview]:
    """The JSON and the binary part of a body."""
    if header_length is None:
        return body, memoryview(b"")
    # Not int() alone: it takes signs, blanks, underscores and any script's digits.
    if not (header_length.isascii() and header_length.isdigit() and len(header_length) <= 12):
        raise InputError(
            f"Inference-Header-Content-Length must be a whole number of bytes, got {_short(header_length)}"
        )
    length = int(header_length)
    if length > len(body):
        raise InputError(
            f"Inference-Header-Content-Length must be at most the body's {len(body)} bytes, got {length}: "
            "was the body truncated?"
        )
    return body[:length], memoryview(body)[length:]


def _points(tensor: Mapping[str, Any], tail: memoryview) -> NDArray[np.float32]:
    name, datatype, shape = tensor.get("name"), tensor.get("datatype"), tensor.get("shape")
    if name != INPUT:
        hint = nearest(name, [INPUT]) if isinstance(name, str) else ""
        raise InputError(f"the input must be named {INPUT!r}, got {_short(name)}{hint}")
    if datatype != "FP32":
        raise InputError(f"input {INPUT!r} must have datatype FP32, got {_short(datatype)}")
    if (
        not isinstance(shape, list)
        or len(shape) != 2
        or any(isinstance(n, bool) or not isinstance(n, int) for n in shape)
        or not 0 <= shape[0] <= _MOST_ROWS
        or shape[1] != 3
    ):
        raise InputError(f"input {INPUT!r} must have shape [P, 3] with P >= 0, got {_short(shape)}")
    parameters = _object(f"parameters of input {INPUT!r}", tensor.get("parameters", {}))
    for unsupported in ("shared_memory_region", "classification"):
        if unsupported in parameters:
            raise InputError(f"input {INPUT!r} must be sent as data or binary data, got {unsupported}")
    size = parameters.get("binary_data_size")
    if size is None:
        if len(tail):
            raise InputError(
                f"input {INPUT!r} must have parameter binary_data_size when bytes follow the JSON, got none "
                f"and {len(tail)} bytes"
            )
        return _from_json(tensor, shape)
    if "data" in tensor:
        raise InputError(f"input {INPUT!r} must have data or binary_data_size, got both")
    return _from_bytes(size, shape, tail)


def _from_bytes(size: object, shape: list[int], tail: memoryview) -> NDArray[np.float32]:
    expected = shape[0] * 12
    if isinstance(size, bool) or not isinstance(size, int) or size != expected:
        raise InputError(
            f"binary_data_size of input {INPUT!r} must be {expected} bytes (FP32 of shape {shape}), got {_short(size)}"
        )
    if len(tail) != expected:
        hint = "was the body truncated, or Inference-Header-Content-Length left out?" if len(tail) < expected else ""
        raise InputError(
            f"the body must have {expected} bytes after the JSON, got {len(tail)}{': ' if hint else ''}{hint}"
        )
    return np.frombuffer(tail, dtype="<f4").reshape(shape)


def _from_json(tensor: Mapping[str, Any], shape: list[int]) -> NDArray[np.float32]:
    data = tensor.get("data")
    if not isinstance(data, list):
        raise InputError(f"input {INPUT!r} must have data, a list, or binary_data_size, got {_kind(data)}")
    if set(map(type, data)) == {list}:
        if len(data) != shape[0] or any(len(row) != 3 for row in data):
            raise InputError(f"data of input {INPUT!r} must be {shape[0]} rows of 3 numbers for shape {shape}")
        data = list(itertools.chain.from_iterable(data))
    if not set(map(type, data)) <= {int, float}:  # not left to numpy, which reads texts as numbers and null as NaN
        raise InputError(f"data of input {INPUT!r} must be numbers, flat or in rows of 3, got other values among them")
    if len(data) != shape[0] * 3:
        raise InputError(f"data of input {INPUT!r} must hold {shape[0] * 3} numbers for shape {shape}, got {len(data)}")
    try:
        values = np.array(data, dtype=np.float64)
    except OverflowError as error:
        raise InputError(f"data of input {INPUT!r} must be numbers within float32, got a huge number") from error
    with np.errstate(over="ignore"):  # becomes infinite, which the estimator refuses by name
        return values.astype(np.float32).reshape(shape)


def _outputs(asked: object, binary: bool) -> tuple[AskedOutput, ...]:
    if asked is None or asked == []:
        return tuple(AskedOutput(name, binary) for name in OUTPUTS)
    if not isinstance(asked, list) or len(asked) > len(OUTPUTS):
        raise InputError(f"outputs must be a list of at most {len(OUTPUTS)}, got {_short(asked)}")
    outputs: list[AskedOutput] = []
    for entry in asked:
        output = _object("an output", entry)
        name = output.get("name")
        if not isinstance(name, str) or name not in OUTPUTS:
            hint = nearest(name, OUTPUTS) if isinstance(name, str) else ""
            raise InputError(f"an output must be one of {', '.join(OUTPUTS)}, got {_short(name)}{hint}")
        if name in (other.name for other in outputs):
            raise InputError(f"an output must be asked for once, got {name!r} twice")
        parameters = _object(f"parameters of output {name!r}", output.get("parameters", {}))
        for unsupported in ("shared_memory_region", "classification"):
            if parameters.get(unsupported):
                raise InputError(f"output {name!r} must be sent as data or binary data, got {unsupported}")
        flag = parameters.get("binary_data", binary)
        outputs.append(AskedOutput(name, _flag(f"parameter binary_data of output {name!r}", flag)))
    return tuple(outputs)


def _deadline_ms(parameters: Mapping[str, Any]) -> float | None:
    for name, factor in (("deadline_ms", 1.0), ("timeout", 1e-3)):
        value = parameters.get(name)
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < 1e12:
            unit = "milliseconds" if factor == 1.0 else "microseconds"
            raise InputError(f"parameter {name} must be a positive number of {unit}, got {_short(value)}")
        return float(value) * factor
    return None


def _flag(what: str, value: object) -> bool:
    if not isinstance(value, bool):
        raise InputError(f"{what} must be true or false, got {_short(value)}")
    return value


def _object(what: str, value: object) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise InputError(f"{what} must be a JSON object, got {_kind(value)}")
    return value


def _kind(value: object) -> str:
    kinds = {dict: "an object", list: "a list", str: "a text", bool: "a truth value", type(None): "none"}
    return kinds.get(type(value), "a number")


def _short(value: object) -> str:
    """A value as it may stand in a sentence: short, whatever it is."""
    return _SHORT.repr(value)
