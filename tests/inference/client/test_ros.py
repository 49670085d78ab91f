"""Answers as Detection3DArray, without ROS: field names, quaternion order, boxes."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from attentionvote.geometry.pose import matrix_from_quaternion, transform
from attentionvote.inference.answer import Abstention, Detection, Estimate
from attentionvote.inference.client.ros import detection_array, to_message
from attentionvote.inference.errors import InputError

BOX = ((-0.05, -0.02, -0.01), (0.07, 0.02, 0.03))


def answer(pose: np.ndarray, confidence: float = 0.75) -> dict[str, Any]:
    found = Detection(pose, confidence, "gear", 4.0)
    return Estimate(
        detections=(found,), part="gear", model="12ab", points_given=9, points_measured=9, points_used=9
    ).to_dict()


@given(st.integers(0, 2**32 - 1))
def test_the_quaternion_is_x_y_z_w_of_the_same_rotation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    quaternion = rng.normal(size=4)  # w, x, y, z
    pose = transform(matrix_from_quaternion(quaternion), rng.normal(size=3))
    (detection,) = detection_array(answer(pose), BOX, "camera", 1.5)["detections"]
    ros = detection["results"][0]["pose"]["pose"]
    turned = Rotation.from_quat([ros["orientation"][name] for name in "xyzw"])  # SciPy's order is ROS' order
    np.testing.assert_allclose(turned.as_matrix(), pose[:3, :3], atol=1e-12)
    assert [ros["position"][name] for name in "xyz"] == pose[:3, 3].tolist()
    # The box turns with the part, and its middle is where the part's box has its own.
    center = detection["bbox"]["center"]
    assert center["orientation"] == ros["orientation"]
    middle = pose @ [0.01, 0.0, 0.01, 1.0]
    np.testing.assert_allclose([center["position"][name] for name in "xyz"], middle[:3], atol=1e-12)
    size = detection["bbox"]["size"]
    np.testing.assert_allclose([size["x"], size["y"], size["z"]], [0.12, 0.04, 0.04], atol=1e-12)


def test_a_quarter_turn_about_z_by_hand() -> None:
    pose = np.array([[0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.2], [0.0, 0.0, 1.0, 0.8], [0.0, 0.0, 0.0, 1.0]])
    content = detection_array(answer(pose), BOX, "camera_optical_frame", (12, 34))
    half = math.sqrt(0.5)
    header = {"stamp": {"sec": 12, "nanosec": 34}, "frame_id": "camera_optical_frame"}
    orientation = {"x": 0.0, "y": 0.0, "z": pytest.approx(half), "w": pytest.approx(half)}
    assert content == {
        "header": header,
        "detections": [
            {
                "header": header,
                "results": [
                    {
                        "hypothesis": {"class_id": "gear", "score": 0.75},
                        "pose": {
                            "pose": {"position": {"x": 0.1, "y": 0.2, "z": 0.8}, "orientation": orientation},
                            "covariance": [0.0] * 36,
                        },
                    }
                ],
                "bbox": {
                    "center": {
                        "position": {"x": pytest.approx(0.1), "y": pytest.approx(0.21), "z": pytest.approx(0.81)},
                        "orientation": orientation,
                    },
                    "size": {"x": pytest.approx(0.12), "y": pytest.approx(0.04), "z": pytest.approx(0.04)},
                },
                "id": "12.000000034-0",
            }
        ],
    }
    json.dumps(content)  # plain data


def test_an_abstention_has_no_detections() -> None:
    empty = Abstention(
        reason="too_few_points", message="0 points", part="gear", model="12ab", points_given=0, points_measured=0,
        points_used=0,
    )  # fmt: skip
    content = detection_array(empty.to_dict(), BOX, "camera", 7)
    assert content["detections"] == []
    assert content["header"]["stamp"] == {"sec": 7, "nanosec": 0}


def test_every_part_has_its_own_box_and_a_part_without_is_refused() -> None:
    found = (Detection(np.eye(4), 0.9, "bolt", 4.0), Detection(np.eye(4), 0.8, "plate", 4.0))
    both = Estimate(detections=found, part="bin", model="1", points_given=9, points_measured=9, points_used=9).to_dict()
    boxes = {"plate": ((0, 0, 0), (1, 2, 3)), "bolt": BOX}
    detections = detection_array(both, boxes, "camera", 0.0)["detections"]
    assert [d["results"][0]["hypothesis"]["class_id"] for d in detections] == ["bolt", "plate"]
    assert detections[0]["bbox"]["size"] == {
        "x": pytest.approx(0.12),
        "y": pytest.approx(0.04),
        "z": pytest.approx(0.04),
    }
    assert detections[1]["bbox"]["size"] == {"x": 1.0, "y": 2.0, "z": 3.0}
    assert detections[1]["bbox"]["center"]["position"] == {"x": 0.5, "y": 1.0, "z": 1.5}
    del boxes["plate"]
    sentence = "box must have the box of every part, got bolt and a pose of 'plate'"
    with pytest.raises(InputError, match=sentence):
        detection_array(both, boxes, "camera", 0.0)


@pytest.mark.parametrize(
    ("stamp", "expected"),
    [
        (1.25, (1, 250_000_000)),
        (0.9999999999, (0, 999_999_999)),
        (1_795_543_000.5, (1_795_543_000, 500_000_000)),
        ((3, 999_999_999), (3, 999_999_999)),
    ],
)
def test_stamps(stamp: Any, expected: tuple[int, int]) -> None:
    made = detection_array({"poses": []}, BOX, "camera", stamp)["header"]["stamp"]
    assert (made["sec"], made["nanosec"]) == expected


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"box": BOX[::-1]}, "box must be the lowest and the highest corner"),
        ({"box": BOX[:1]}, "box must be the lowest and the highest corner"),
        ({"frame_id": ""}, "frame_id must name the camera's optical frame"),
        ({"answer": {"error": "no"}}, "an answer must have the list poses, got none: was the request refused"),
        ({"answer": {"poses": [{"camera_from_part": [1.0], "confidence": 1, "part": "x"}]}}, r"shape \(4, 4\), got"),
        ({"stamp_s": -1.0}, "stamp_s must be seconds since the epoch"),
        ({"stamp_s": float("nan")}, "stamp_s must be seconds since the epoch"),
        ({"stamp_s": (1, 10**9)}, "stamp_s must be seconds since the epoch"),
    ],
)
def test_impossible_arguments(changes: dict[str, Any], sentence: str) -> None:
    given = {"answer": {"poses": []}, "box": BOX, "frame_id": "camera", "stamp_s": 1.0} | changes
    with pytest.raises(InputError, match=sentence):
        detection_array(**given)


def message(name: str, **defaults: Callable[[], Any]) -> type:
    """A class with slots for exactly these fields, as ROS' Python messages are: other names raise AttributeError."""
    namespace = {key: field(default_factory=make) for key, make in defaults.items()}
    made = type(name, (), {"__annotations__": dict.fromkeys(defaults, "Any"), **namespace})
    return dataclass(slots=True)(made)


Time = message("Time", sec=int, nanosec=int)
Header = message("Header", stamp=Time, frame_id=str)
Point = message("Point", x=float, y=float, z=float)
Quaternion = message("Quaternion", x=float, y=float, z=float, w=lambda: 1.0)
Pose = message("Pose", position=Point, orientation=Quaternion)
PoseWithCovariance = message("PoseWithCovariance", pose=Pose, covariance=lambda: [0.0] * 36)
Hypothesis = message("ObjectHypothesis", class_id=str, score=float)
VISION_MSGS = SimpleNamespace(
    ObjectHypothesisWithPose=message("ObjectHypothesisWithPose", hypothesis=Hypothesis, pose=PoseWithCovariance),
    Detection3D=message(
        "Detection3D",
        header=Header,
        results=list,
        bbox=message("BoundingBox3D", center=Pose, size=Point),
        id=str,
    ),
    Detection3DArray=message("Detection3DArray", header=Header, detections=list),
)


def as_plain(value: Any) -> Any:
    """A message as plain data again."""
    if hasattr(value, "__dataclass_fields__"):
        return {f.name: as_plain(getattr(value, f.name)) for f in fields(value)}
    return [as_plain(item) for item in value] if isinstance(value, list) else value


def test_every_field_reaches_the_message() -> None:
    content = detection_array(answer(np.eye(4)), BOX, "camera", 2.0)
    assert as_plain(to_message(content, VISION_MSGS)) == content


def test_without_ros_the_import_error_says_what_is_missing() -> None:
    assert "vision_msgs" not in sys.modules
    with pytest.raises(ImportError, match="vision_msgs"):
        to_message(detection_array({"poses": []}, BOX, "camera", 0.0))
