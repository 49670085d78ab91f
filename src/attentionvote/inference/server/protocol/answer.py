"""Answers of the Open Inference Protocol: metadata, and poses as tensors, JSON or binary. Pure."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attentionvote.contract import FRAME, UNITS, ModelCard
from attentionvote.inference.server.protocol.request import INPUT, OUTPUTS, AskedOutput

PLATFORM = "attentionvote_pose"
EXTENSIONS = ("binary_tensor_data", "model_repository", "parameters")
_SHAPES = {"camera_from_part": [-1, 4, 4]}
_DTYPES = {"FP64": "<f8", "FP32": "<f4", "INT64": "<i8", "BYTES": "O"}
_CONFIG_TYPES = {"BYTES": "TYPE_STRING"}
_LENGTH = struct.Struct("<I")


def parts_of(card: ModelCard) -> list[dict[str, Any]]:
    """The parts that a model knows, in the order of ``class_index``: what a client needs beside a pose."""
    return [
        {
            "class_index": i,
            "name": part.name,
            "title": part.title,
            "diameter": part.diameter,
            "symmetry": dict(part.symmetry),
            "box": [list(corner) for corner in part.box],
        }
        for i, part in enumerate(card.each_part)
    ]


def model_metadata(name: str, version: str, card: ModelCard) -> dict[str, Any]:
    """What ``/v2/models/{name}`` answers."""
    return {
        "name": name,
        "versions": [version],
        "platform": PLATFORM,
        "inputs": [{"name": INPUT, "datatype": "FP32", "shape": [-1, 3]}],
        "outputs": [{"name": key, "datatype": kind, "shape": _SHAPES.get(key, [-1])} for key, kind in OUTPUTS.items()],
        "parameters": {"parts": parts_of(card)},
    }


def model_config(name: str) -> dict[str, Any]:
    """What ``/v2/models/{name}/config`` answers: the fields of Triton's that are true here."""
    return {
        "name": name,
        "platform": PLATFORM,
        "max_batch_size": 0,
        "input": [{"name": INPUT, "data_type": "TYPE_FP32", "dims": [-1, 3]}],
        "output": [
            {"name": key, "data_type": _CONFIG_TYPES.get(kind, f"TYPE_{kind}"), "dims": _SHAPES.get(key, [-1])}
            for key, kind in OUTPUTS.items()
        ],
    }


def pose_tensors(poses: Sequence[Mapping[str, Any]], classes: Sequence[str]) -> dict[str, NDArray[Any]]:
    """The poses of an answer as tensors.

    Args:
        poses: each with ``camera_from_part`` (4, 4), ``confidence``, ``heat`` and ``part``.
        classes: names of the model's classes.

    Returns:
        ``camera_from_part`` ``(n, 4, 4)`` float64, metres; ``confidence`` and ``heat`` ``(n,)`` float32;
        ``class_index`` ``(n,)`` int64, and its name, ``part`` ``(n,)`` texts.
    """
    n = len(poses)
    return {
        "camera_from_part": np.array([pose["camera_from_part"] for pose in poses], np.float64).reshape(n, 4, 4),
        "confidence": np.array([pose["confidence"] for pose in poses], np.float32),
        "heat": np.array([pose["heat"] for pose in poses], np.float32),
        "class_index": np.array([classes.index(pose["part"]) for pose in poses], np.int64),
        "part": np.array([pose["part"] for pose in poses], object),
    }


def answer_parameters(answer: Mapping[str, Any], part: str, digest: str) -> dict[str, Any]:
    """What travels beside the tensors: why there are none, and what they mean.

    Args:
        answer: of the estimator, as plain data.
        part: the model's name.
        digest: of the bundle.
    """
    return {
        "status": answer.get("reason", "ok"),
        "message": answer.get("message", ""),
        "warnings": "; ".join(answer.get("warnings", ())),
        "part": part,
        "frame": FRAME,
        "units": UNITS,
        "digest": digest,
    }


def encode_answer(
    name: str,
    version: str,
    identity: str,
    parameters: Mapping[str, Any],
    tensors: Mapping[str, NDArray[Any]],
    asked: Sequence[AskedOutput],
) -> tuple[bytes, int | None]:
    """The body of an answer, and the length of its JSON part when bytes follow it (else None).

    Args:
        name, version: of the model.
        identity: the request's id; left out when empty.
        parameters: of the answer.
        tensors: by name.
        asked: which of them, in this order, and how.
    """
    outputs, binary = [], []
    for output in asked:
        datatype = OUTPUTS[output.name]
        values = np.ascontiguousarray(tensors[output.name], dtype=_DTYPES[datatype])
        entry: dict[str, Any] = {"name": output.name, "datatype": datatype, "shape": list(values.shape)}
        if output.binary:
            binary.append(_packed_texts(values) if datatype == "BYTES" else values.tobytes())
            entry["parameters"] = {"binary_data_size": len(binary[-1])}
        else:
            entry["data"] = values.reshape(-1).tolist()
        outputs.append(entry)
    content: dict[str, Any] = {"model_name": name, "model_version": version}
    if identity:
        content["id"] = identity
    content |= {"parameters": dict(parameters), "outputs": outputs}
    head = json.dumps(content, allow_nan=False).encode("utf-8")
    if not binary:
        return head, None
    return b"".join([head, *binary]), len(head)


def _packed_texts(texts: NDArray[Any]) -> bytes:
    """The protocol's binary form of texts: each its length in bytes (32 bits, little-endian) and itself in UTF-8."""
    encoded = [text.encode() for text in texts]
    return b"".join(_LENGTH.pack(len(text)) + text for text in encoded)
