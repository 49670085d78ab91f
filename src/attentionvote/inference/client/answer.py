"""What a client gets: poses or their absence, decoded from binary tensors, or one of a few kinds of errors."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

LENGTH_HEADER = "Inference-Header-Content-Length"
_DTYPES = {"FP32": "<f4", "FP64": "<f8"}


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
        status: ``ok``, or the reason why there is none: one of ``inference.answer.REASONS``.
        message: the status in a sentence; empty when ok.
        warnings: about an unusual cloud; empty without.
        part: what was looked for.
        version: of the model, the first digits of its bundle's digest.
        frame, units: of the poses.
    """

    camera_from_part: NDArray[np.float64]
    confidence: NDArray[np.float32]
    heat: NDArray[np.float32]
    status: str
    message: str
    warnings: str
    part: str
    version: str
    frame: str
    units: str

    def to_dict(self) -> dict[str, Any]:
        """Plain data with the list ``poses``, as ``/poses`` answers it."""
        poses = zip(self.camera_from_part.tolist(), self.confidence.tolist(), self.heat.tolist(), strict=True)
        names = ("status", "message", "warnings", "part", "version", "frame", "units")
        return {
            "poses": [
                {"camera_from_part": pose, "confidence": confidence, "heat": heat, "part": self.part}
                for pose, confidence, heat in poses
            ],
            **{name: getattr(self, name) for name in names},
        }


def decode_answer(body: bytes, header_length: str | None) -> Answer:
    """The answer in a response with binary tensors.

    Args:
        body: of the response.
        header_length: value of ``Inference-Header-Content-Length``.

    Raises:
        ServerFailed: when it is none.
    """
    try:
        length = int(header_length or "")
        content = json.loads(body[:length])
        tensors, at = {}, length
        for output in content["outputs"]:
            size = output["parameters"]["binary_data_size"]
            values = np.frombuffer(body[at : at + size], dtype=_DTYPES[output["datatype"]])
            tensors[output["name"]] = values.reshape(output["shape"])
            at += size
        said = content["parameters"]
        return Answer(
            tensors["camera_from_part"],
            tensors["confidence"],
            tensors["heat"],
            status=str(said["status"]),
            message=str(said["message"]),
            warnings=str(said["warnings"]),
            part=str(said["part"]),
            version=str(content["model_version"]),
            frame=str(said["frame"]),
            units=str(said["units"]),
        )
    except (ValueError, KeyError, TypeError) as error:
        raise ServerFailed(f"the answer must hold poses as binary tensors, but it cannot be read ({error})") from error
