"""Poses as tensors and back."""

from __future__ import annotations

import json

import numpy as np
import pytest

from attentionvote.inference.client.pose_client import decode_answer
from attentionvote.inference.server.protocol.answer import encode_answer, pose_tensors
from attentionvote.inference.server.protocol.request import OUTPUTS, AskedOutput


@pytest.mark.parametrize("count", [0, 1, 7])
def test_binary_answers_come_back_bit_for_bit(count: int) -> None:
    rng = np.random.default_rng(count)
    poses = [
        {
            "camera_from_part": rng.normal(size=(4, 4)).tolist(),
            "confidence": float(np.float32(rng.random())),
            "heat": 2.5,
            "part": ("bolt", "plåte")[i % 2],
        }
        for i in range(count)
    ]
    tensors = pose_tensors(poses, ("bolt", "plåte"))
    parameters = {"status": "ok", "message": "", "warnings": "", "part": "gear", "frame": "camera", "units": "m"}
    asked = [AskedOutput(name, True) for name in reversed(OUTPUTS)]
    body, head = encode_answer("gear", "12ab", "id-7", parameters, tensors, asked)
    answer = decode_answer(body, str(head))
    np.testing.assert_array_equal(answer.camera_from_part, tensors["camera_from_part"])
    np.testing.assert_array_equal(answer.confidence, tensors["confidence"])
    np.testing.assert_array_equal(answer.heat, tensors["heat"])
    np.testing.assert_array_equal(answer.class_index, tensors["class_index"])
    assert answer.class_index.dtype == np.int64
    assert answer.part_names == tuple(pose["part"] for pose in poses)
    assert answer.camera_from_part.shape == (count, 4, 4)
    assert (answer.part, answer.version, answer.units) == ("gear", "12ab", "m")


def test_json_and_binary_may_be_mixed() -> None:
    tensors = pose_tensors(
        [{"camera_from_part": np.eye(4).tolist(), "confidence": 0.5, "heat": 2.0, "part": "x"}], ["x"]
    )
    asked = [AskedOutput("heat", False), AskedOutput("camera_from_part", True)]
    body, head = encode_answer("gear", "1", "", {}, tensors, asked)
    content = json.loads(body[:head])
    assert "id" not in content
    assert content["outputs"][0] == {"name": "heat", "datatype": "FP32", "shape": [1], "data": [2.0]}
    assert content["outputs"][1]["parameters"] == {"binary_data_size": 128}
    np.testing.assert_array_equal(np.frombuffer(body[head:], "<f8").reshape(4, 4), np.eye(4))
    alone, none = encode_answer("gear", "1", "", {}, tensors, asked[:1])
    assert none is None
    assert json.loads(alone)["outputs"] == content["outputs"][:1]
