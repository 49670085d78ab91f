"""A client's answer: poses or their absence, decoded from binary tensors, or one of a few kinds of errors."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

LENGTH_HEADER = "Inference-Header-Content-Length"
_DTYPES = {"FP32": "<f4", "FP64": "<f8", "INT64": "<i8"}


class PoseClientError(RuntimeError):
    """The request was not answered with poses or their absence; the text is the server's sentence where it sent one."""


class Rejected(PoseClientError):
    """The server refused what was sent (4xx): sending it again does not help."""


class Unauthorized(Rejected):
    """The token is missing or wrong (401)."""


class Unavailable(PoseClientError):
    """No place or no model until the deadline, retries included (503)."""


class DeadlinePassed(PoseClientError):
    """There was no answer in time (504, or silence)."""


class Unreachable(PoseClientError):
    """There is no connection, or it broke off."""


class ServerFailed(PoseClientError):
    """The server met an internal error, or answered something that is no answer (500)."""


@dataclass(frozen=True, eq=False)
class Answer:
    """Poses, or why there are none.

    Attributes:
        camera_from_part: ``(n, 4, 4)`` float64, metres, most confident first.
        confidence: ``(n,)`` float32.
        heat: ``(n,)`` float32, how many votes agree on each.
        class_index: ``(n,)`` int64, which of the model's parts each pose is of (``parts`` of the server's metadata).
        part_names: the name of that part, one a pose.
        status: ``ok``, or the reason why there is none: one of ``inference.answer.REASONS``.
        message: the status in a sentence; empty when ok.
        warnings: about an unusual cloud; empty without.
        part: what was looked for: the model's name, of a set of parts the set's.
        version: of the model, the first digits of its bundle's digest.
        frame, units: of the poses.
    """

    camera_from_part: NDArray[np.float64]
    confidence: NDArray[np.float32]
    heat: NDArray[np.float32]
    class_index: NDArray[np.int64]
    part_names: tuple[str, ...]
    status: str
    message: str
    warnings: str
    part: str
    version: str
    frame: str
    units: str

    def to_dict(self) -> dict[str, Any]:
        """Plain data with the list ``poses``, as ``/poses`` answers it."""
        columns = self.camera_from_part.tolist(), self.confidence.tolist(), self.heat.tolist(), self.part_names
        names = ("status", "message", "warnings", "part", "version", "frame", "units")
        return {
            "poses": [
                {"camera_from_part": pose, "confidence": confidence, "heat": heat, "part": part}
                for pose, confidence, heat, part in zip(*columns, strict=True)
            ],
            **{name: getattr(self, name) for name in names},
        }


def decode_answer(body: bytes, header_length: str | None) -> Answer:
    """The answer in a response with binary tensors. Servers of version 0.1 do not say which part a pose is of.

    Args:
        body: of the response.
        header_length: value of ``Inference-Header-Content-Length``.

    Raises:
        ServerFailed: when it is none.
    """
    try:
        length = int(header_length or "")
        content = json.loads(body[:length])
        tensors: dict[str, NDArray[Any]] = {}
        names: tuple[str, ...] | None = None
        at = length
        for output in content["outputs"]:
            size = output["parameters"]["binary_data_size"]
            piece = body[at : at + size]
            at += size
            if output["name"] == "part":
                names = _texts(piece, int(output["shape"][0]))
            else:
                values = np.frombuffer(piece, dtype=_DTYPES[output["datatype"]])
                tensors[output["name"]] = values.reshape(output["shape"])
        parameters = content["parameters"]
        n = len(tensors["confidence"])
        return Answer(
            tensors["camera_from_part"],
            tensors["confidence"],
            tensors["heat"],
            tensors.get("class_index", np.zeros(n, np.int64)),
            (str(parameters["part"]),) * n if names is None else names,
            status=str(parameters["status"]),
            message=str(parameters["message"]),
            warnings=str(parameters["warnings"]),
            part=str(parameters["part"]),
            version=str(content["model_version"]),
            frame=str(parameters["frame"]),
            units=str(parameters["units"]),
        )
    except (ValueError, KeyError, TypeError, IndexError, struct.error) as error:
        raise ServerFailed(f"the answer must hold poses as binary tensors, but it cannot be read ({error})") from error


def _texts(packed: bytes, count: int) -> tuple[str, ...]:
    """Texts that each follow their length (32 bits, little-endian)."""
    texts, at = [], 0
    for _ in range(count):
        (length,) = struct.unpack_from("<I", packed, at)
        at += 4 + length
        if at > len(packed):
            raise ValueError("a text is cut off")
        texts.append(packed[at - length : at].decode())
    return tuple(texts)
