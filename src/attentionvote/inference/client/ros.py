"""Answers as ROS 2 messages: ``vision_msgs/Detection3DArray``, first as plain data, then as the real message.

The mapping needs no ROS and is tested without it. A node on a machine with ROS asks the cell with
:class:`attentionvote.inference.client.PoseClient` and publishes ``to_message(detection_array(...))``. The camera
frame of this package is ROS' optical frame (x right, y down, z forward), so nothing is turned; only the quaternion's
order differs: ROS writes x, y, z, w.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from attentionvote.geometry.pose import quaternion_from_matrix
from attentionvote.inference.errors import InputError, nearest


def detection_array(
    answer: Mapping[str, Any],
    box: ArrayLike | Mapping[str, ArrayLike],
    frame_id: str,
    stamp_s: float | tuple[int, int],
) -> dict[str, Any]:
    """An answer in the shape of ``vision_msgs/Detection3DArray``; no poses, no detections.

    Args:
        answer: of ``/poses``, of an estimator's ``to_dict()`` or of the client's ``Answer.to_dict()``.
        box: ``(2, 3)`` lowest and highest corner of the part in its own frame, metres, or one such box for each name
            of a part: ``{part["name"]: part["box"] for part in PoseClient.metadata()["model"]["parts"]}``.
        frame_id: of the camera's optical frame.
        stamp_s: when the cloud was measured: seconds since the epoch, or whole seconds and nanoseconds.

    Raises:
        InputError: when the answer has no poses, a pose's part no box, or box, frame or time is impossible.
    """
    boxes = {name: _corners(each) for name, each in box.items()} if isinstance(box, Mapping) else _corners(box)
    if not frame_id:
        raise InputError("frame_id must name the camera's optical frame, got an empty text")
    poses = answer.get("poses")
    if not isinstance(poses, Sequence) or isinstance(poses, str):
        raise InputError("an answer must have the list poses, got none: was the request refused?")
    header = {"stamp": _stamp(stamp_s), "frame_id": frame_id}
    detections = [_detection(pose, i, _box_of(pose, boxes), header) for i, pose in enumerate(poses)]
    return {"header": header, "detections": detections}


def _corners(box: ArrayLike) -> NDArray[np.float64]:
    corners = np.asarray(box, dtype=np.float64)
    if corners.shape != (2, 3) or not (np.isfinite(corners).all() and (corners[0] <= corners[1]).all()):
        raise InputError(f"box must be the lowest and the highest corner (2, 3) in metres, got {corners.tolist()}")
    return corners


def _box_of(
    pose: Mapping[str, Any], boxes: NDArray[np.float64] | Mapping[str, NDArray[np.float64]]
) -> NDArray[np.float64]:
    """The box of the pose's part."""
    if not isinstance(boxes, Mapping):
        return boxes
    name = str(pose["part"])
    if name not in boxes:
        hint = nearest(name, boxes)
        raise InputError(f"box must have the box of every part, got {', '.join(boxes)} and a pose of {name!r}{hint}")
    return boxes[name]


def _stamp(stamp_s: float | tuple[int, int]) -> dict[str, int]:
    if isinstance(stamp_s, tuple):
        seconds, nanoseconds = stamp_s
    elif math.isfinite(stamp_s):
        seconds = math.floor(stamp_s)
        nanoseconds = min(round((stamp_s - seconds) * 1e9), 999_999_999)
    else:
        seconds, nanoseconds = -1, 0
    if not (0 <= seconds < 2**31 and 0 <= nanoseconds < 10**9):
        raise InputError(f"stamp_s must be seconds since the epoch that a ROS time can hold, got {stamp_s}")
    return {"sec": int(seconds), "nanosec": int(nanoseconds)}


def _detection(pose: Mapping[str, Any], index: int, box: np.ndarray, header: Mapping[str, Any]) -> dict[str, Any]:
    camera_from_part = np.asarray(pose["camera_from_part"], dtype=np.float64)
    if camera_from_part.shape != (4, 4):
        raise InputError(f"camera_from_part must have shape (4, 4), got {camera_from_part.shape}")
    w, x, y, z = map(float, quaternion_from_matrix(camera_from_part[:3, :3]))
    orientation = {"x": x, "y": y, "z": z, "w": w}
    middle = camera_from_part[:3, :3] @ box.mean(axis=0) + camera_from_part[:3, 3]
    stamp = header["stamp"]
    return {
        "header": dict(header),
        "results": [
            {
                "hypothesis": {"class_id": str(pose["part"]), "score": float(pose["confidence"])},
                "pose": {
                    "pose": {"position": _vector(camera_from_part[:3, 3]), "orientation": orientation},
                    "covariance": [0.0] * 36,
                },
            }
        ],
        "bbox": {
            "center": {"position": _vector(middle), "orientation": dict(orientation)},
            "size": _vector(box[1] - box[0]),
        },
        # The same id in two messages would say that it is the same part, which nobody knows.
        "id": f"{stamp['sec']}.{stamp['nanosec']:09d}-{index}",
    }


def _vector(values: np.ndarray) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))


def to_message(content: Mapping[str, Any], messages: Any = None) -> Any:
    """The real message of :func:`detection_array`'s plain data.

    Args:
        content: of :func:`detection_array`.
        messages: a module with ``Detection3DArray``, ``Detection3D`` and ``ObjectHypothesisWithPose``;
            ``vision_msgs.msg`` when None.

    Raises:
        ImportError: when this machine has no ``vision_msgs``: source its ROS 2 environment.
    """
    if messages is None:
        messages = importlib.import_module("vision_msgs.msg")
    array = messages.Detection3DArray()
    _fill(array, {"header": content["header"]})
    for entry in content["detections"]:
        detection = messages.Detection3D()
        _fill(detection, {name: value for name, value in entry.items() if name != "results"})
        for result in entry["results"]:
            hypothesis = messages.ObjectHypothesisWithPose()
            _fill(hypothesis, result)
            detection.results.append(hypothesis)
        array.detections.append(detection)
    return array


def _fill(message: Any, content: Mapping[str, Any]) -> None:
    """Set a message's fields; a nested message is there already and filled in place."""
    for name, value in content.items():
        if isinstance(value, Mapping):
            _fill(getattr(message, name), value)
        else:
            setattr(message, name, value)
