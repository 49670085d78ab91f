"""Which part a pose is: the same over every interface of the cell."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import tritonclient.http as triton

from attentionvote.contract import PartCard
from attentionvote.inference.client.pose_client import PoseClient
from attentionvote.inference.client.ros import detection_array

BOLT_BOX = ((-0.05, -0.02, -0.01), (0.05, 0.02, 0.01))
PLATE_BOX = ((-0.04, -0.03, -0.005), (0.04, 0.03, 0.005))
TURNING = {"kind": "revolution", "axis": [0.0, 0.0, 1.0], "flip": False}
BOLT = PartCard("bolt", "a bolt", 0.09, "1" * 64, TURNING, BOLT_BOX)
PLATE = PartCard("plåte", "a plate", 0.1, "2" * 64, {"kind": "none"}, PLATE_BOX)
TWO: dict[str, Any] = {"classes": ("bolt", "plåte"), "parts": (BOLT, PLATE), "part": {"name": "bin"}}
NAMED = (1, 0, 0, 1)  # the second proposal, the most confident one, is a bolt; the first is a plate
NAMES, INDEX = ["bolt", "plåte"], [0, 1]


@pytest.fixture
def server(start_server: Any, make_bundle: Any) -> Any:
    """Serves a bin of two kinds of parts."""
    return start_server(make_bundle(card=TWO, graph={"named": NAMED}))


def test_every_interface_says_which_part_a_pose_is(server: Any, make_cloud: Any, npy: Any, infer_body: Any) -> None:
    cloud = make_cloud()
    plain = server.post("/poses", npy(cloud)).json
    assert [pose["part"] for pose in plain["poses"]] == NAMES

    body, headers = infer_body(cloud)
    outputs = {o["name"]: o for o in server.post("/v2/models/bin/infer", body, headers).json["outputs"]}
    assert outputs["part"] == {"name": "part", "datatype": "BYTES", "shape": [2], "data": NAMES}
    assert outputs["class_index"] == {"name": "class_index", "datatype": "INT64", "shape": [2], "data": INDEX}

    client = triton.InferenceServerClient(server.address)
    try:
        tensor = triton.InferInput("points", list(cloud.shape), "FP32")
        tensor.set_data_from_numpy(cloud, binary_data=True)
        for binary in (True, False):
            asked = [triton.InferRequestedOutput(name, binary_data=binary) for name in ("part", "heat", "class_index")]
            answer = client.infer("bin", [tensor], outputs=asked)
            texts = [t.decode() if isinstance(t, bytes) else t for t in answer.as_numpy("part")]
            assert texts == NAMES
            assert answer.as_numpy("class_index").dtype == np.int64
            assert answer.as_numpy("class_index").tolist() == INDEX
        everything = client.infer("bin", [tensor])
        assert [t.decode() for t in everything.as_numpy("part")] == NAMES
        parts = client.get_model_metadata("bin")["parameters"]["parts"]
    finally:
        client.close()
    assert [(p["class_index"], p["name"], p["diameter"]) for p in parts] == [(0, "bolt", 0.09), (1, "plåte", 0.1)]
    assert parts[0]["symmetry"] == TURNING
    assert parts[1]["box"] == [list(corner) for corner in PLATE_BOX]

    with PoseClient(server.url) as cell:
        found = cell.estimate(cloud)
        assert cell.metadata()["model"]["parts"] == parts
    assert found.part == "bin"
    assert found.part_names == ("bolt", "plåte")
    assert found.class_index.tolist() == INDEX
    assert [pose["part"] for pose in found.to_dict()["poses"]] == NAMES

    boxes = {part["name"]: part["box"] for part in parts}
    for answer in (plain, found.to_dict()):
        detections = detection_array(answer, boxes, "camera", 0.0)["detections"]
        assert [d["results"][0]["hypothesis"]["class_id"] for d in detections] == NAMES
        sizes = [list(d["bbox"]["size"].values()) for d in detections]
        np.testing.assert_allclose(sizes, [[0.1, 0.04, 0.02], [0.08, 0.06, 0.01]])


def test_no_poses_are_no_parts(server: Any) -> None:
    with PoseClient(server.url) as cell:
        empty = cell.estimate(np.zeros((0, 3), np.float32))
    assert (empty.part_names, empty.class_index.shape) == ((), (0,))
