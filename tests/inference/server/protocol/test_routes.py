"""The Open Inference Protocol over HTTP: Triton's stock client unchanged, and what a wrong request is told."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tritonclient.http as triton

from attentionvote.inference.answer import Estimate
from attentionvote.inference.bundles.bundle import load_bundle
from attentionvote.inference.estimator import PoseEstimator

ENCODE = tuple[bytes, dict[str, str]]


@contextmanager
def triton_client(address: str) -> Iterator[triton.InferenceServerClient]:
    """Triton's client, closed at the end."""
    client = triton.InferenceServerClient(address)
    try:
        yield client
    finally:
        client.close()


def cloud_input(points: np.ndarray, binary: bool) -> triton.InferInput:
    tensor = triton.InferInput("points", list(points.shape), "FP32")
    tensor.set_data_from_numpy(points, binary_data=binary)
    return tensor


@pytest.mark.parametrize("binary_in", [True, False], ids=["binary in", "JSON in"])
@pytest.mark.parametrize("binary_out", [True, False, None], ids=["binary out", "JSON out", "default out"])
def test_the_stock_triton_client_gets_the_estimators_poses(
    shared_server: Any, make_cloud: Any, trusted_key: Path, binary_in: bool, binary_out: bool | None
) -> None:
    points = make_cloud(seed=5)
    kept = shared_server.log_file.parent / "state0" / "kept"
    with PoseEstimator(load_bundle(next(kept.iterdir()), trusted_key)) as estimator:
        expected = estimator.estimate(points)
    assert isinstance(expected, Estimate)
    outputs = None
    if binary_out is not None:
        names = ("heat", "camera_from_part", "confidence")
        outputs = [triton.InferRequestedOutput(name, binary_data=binary_out) for name in names]
    with triton_client(shared_server.address) as client:
        answer = client.infer("bracket", [cloud_input(points, binary_in)], outputs=outputs, request_id="scan-1")
    poses = answer.as_numpy("camera_from_part")
    assert poses.dtype == np.float64
    np.testing.assert_array_equal(poses, [d.camera_from_part for d in expected.detections])
    np.testing.assert_array_equal(
        answer.as_numpy("confidence"), np.float32([d.confidence for d in expected.detections])
    )
    np.testing.assert_array_equal(answer.as_numpy("heat"), np.float32([d.heat for d in expected.detections]))
    said = answer.get_response()
    assert said["id"] == "scan-1"
    assert said["model_version"] == expected.model
    parameters = said["parameters"]
    assert parameters["status"] == "ok"
    assert (parameters["part"], parameters["units"]) == ("bracket", "m")
    assert parameters["frame"].startswith("camera: x right")
    assert parameters["digest"].startswith(expected.model)


def test_the_stock_triton_client_sees_health_and_metadata(shared_server: Any) -> None:
    with triton_client(shared_server.address) as client:
        assert client.is_server_live()
        assert client.is_server_ready()
        assert client.is_model_ready("bracket")
        assert not client.is_model_ready("gear")
        assert client.get_server_metadata()["extensions"] == ["binary_tensor_data", "model_repository", "parameters"]
        metadata = client.get_model_metadata("bracket")
        version = metadata["versions"][0]
        assert version == shared_server.version()
        assert client.is_model_ready("bracket", version)
        assert metadata["inputs"] == [{"name": "points", "datatype": "FP32", "shape": [-1, 3]}]
        outputs = {o["name"]: (o["datatype"], o["shape"]) for o in metadata["outputs"]}
        assert outputs == {
            "camera_from_part": ("FP64", [-1, 4, 4]),
            "confidence": ("FP32", [-1]),
            "heat": ("FP32", [-1]),
            "class_index": ("INT64", [-1]),
            "part": ("BYTES", [-1]),
        }
        (part,) = metadata["parameters"]["parts"]
        assert (part["class_index"], part["name"], part["diameter"]) == (0, "bracket", 0.1)
        assert client.get_model_repository_index() == [
            {"name": "bracket", "version": version, "state": "READY", "reason": ""}
        ]
        client.load_model("bracket")  # nothing new there


def test_an_empty_bin_is_an_answer_for_triton_too(shared_server: Any) -> None:
    with triton_client(shared_server.address) as client:
        for binary in (True, False):
            answer = client.infer("bracket", [cloud_input(np.zeros((0, 3), np.float32), binary)])
            assert answer.as_numpy("camera_from_part").shape == (0, 4, 4)
            assert answer.as_numpy("confidence").shape == (0,)
            assert answer.get_response()["parameters"]["status"] == "too_few_points"
            assert "at least 30 are needed" in answer.get_response()["parameters"]["message"]


def test_tritons_client_shows_the_servers_sentence(shared_server: Any, make_cloud: Any) -> None:
    cloud = make_cloud()
    with triton_client(shared_server.address) as client:
        for points, sentence in (
            (cloud * 1000, "points must be metres: .* were millimetres sent"),
            (np.full((100, 3), 2e38, np.float32), r"points must be metres: the cloud is 0 wide and 2e\+38 deep"),
            (cloud * np.float32([1, -1, -1]), "points must lie before the camera, in its frame"),
        ):
            with pytest.raises(triton.InferenceServerException, match=sentence) as caught:
                client.infer("bracket", [cloud_input(points, True)])
            assert caught.value.status() == "400"
        with pytest.raises(triton.InferenceServerException, match="got 'braket', did you mean 'bracket'") as caught:
            client.infer("braket", [cloud_input(cloud, True)])
        assert caught.value.status() == "404"
        with pytest.raises(triton.InferenceServerException, match=r"must be sent without compression, got .*gzip"):
            client.infer("bracket", [cloud_input(cloud, True)], request_compression_algorithm="gzip")


def test_a_version_is_served_or_refused(shared_server: Any, make_cloud: Any, infer_body: Callable[..., ENCODE]) -> None:
    version = shared_server.version()
    body, headers = infer_body(make_cloud())
    right = shared_server.post(f"/v2/models/bracket/versions/{version}/infer", body, headers)
    assert right.status == 200
    assert right.json["model_version"] == version  # no binary output was asked for
    wrong = shared_server.post("/v2/models/bracket/versions/1/infer", body, headers)
    assert wrong.status == 404
    assert f"must be '{version}', which is served here, got '1': leave the version out" in wrong.error
    assert shared_server.get(f"/v2/models/bracket/versions/{version}").json["versions"] == [version]
    assert shared_server.get("/v2/models/bracket/versions/1/ready").status == 404


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda body, headers: (body[:-5], headers), "must have 36000 bytes after the JSON, got 35995: was the body"),
        (lambda body, _: (body, {}), "must be JSON in UTF-8"),
        (lambda _, __: (b"", {}), "must be JSON in UTF-8"),
        (lambda body, headers: (body.replace(b"FP32", b"FP16"), headers), "datatype FP32, got 'FP16'"),
        (lambda body, headers: (body.replace(b'"shape": [3000, 3]', b'"shape": [9000, 1]'), headers), "shape .P, 3."),
    ],
    ids=["truncated", "no header", "empty", "datatype", "shape"],
)
def test_malformed_requests_are_told_why(
    shared_server: Any, make_cloud: Any, infer_body: Callable[..., ENCODE], change: Any, sentence: str
) -> None:
    body, headers = change(*infer_body(make_cloud()))
    reply = shared_server.post("/v2/models/bracket/infer", body, headers)
    assert reply.status == 400
    assert sentence.replace(".P, 3.", "[P, 3]") in reply.error


def test_the_deadline_parameter_counts(slow_server: Any, make_cloud: Any, infer_body: Callable[..., ENCODE]) -> None:
    server = slow_server
    body, headers = infer_body(make_cloud(), deadline_ms=20)
    late = server.post("/v2/models/bracket/infer", body, headers)
    assert late.status == 504
    assert "deadline of " in late.error
    assert late.json["reason"] == "deadline_exceeded"
    body, headers = infer_body(make_cloud(), deadline_ms=20_000)
    tight = {**headers, "X-Deadline-Ms": "30000"}
    assert server.post("/v2/models/bracket/infer", body, tight).status == 200
    body, headers = infer_body(make_cloud(), deadline_ms=0.5)
    refused = server.post("/v2/models/bracket/infer", body, headers)
    assert refused.status == 400
    assert "parameter deadline_ms must be at least 1 millisecond, got 0.5" in refused.error


def test_index_and_load_over_plain_http(shared_server: Any) -> None:
    assert shared_server.post("/v2/repository/index", b'{"ready": true}').status == 200
    assert shared_server.post("/v2/repository/index", b"{").status == 400
    assert shared_server.post("/v2/repository/index", b" " * 5000).status == 413
    loaded = shared_server.post("/v2/repository/models/bracket/load", b"{}")
    assert loaded.json == {"name": "bracket", "version": shared_server.version(), "state": "READY"}
    assert shared_server.post("/v2/repository/models/gear/load").status == 404


def test_json_answers_without_binary_have_no_length_header(
    shared_server: Any, make_cloud: Any, infer_body: Callable[..., ENCODE]
) -> None:
    body, headers = infer_body(make_cloud())
    reply = shared_server.post("/v2/models/bracket/infer", body, headers)
    assert "Inference-Header-Content-Length" not in reply.headers
    assert reply.headers["content-type"] == "application/json"
    shapes = {output["name"]: output["shape"] for output in reply.json["outputs"]}
    assert shapes == {"camera_from_part": [2, 4, 4], "confidence": [2], "heat": [2], "class_index": [2], "part": [2]}
    body, headers = infer_body(make_cloud(), binary_data_output=True)
    reply = shared_server.post("/v2/models/bracket/infer", body, headers)
    head = json.loads(reply.body[: int(reply.headers["Inference-Header-Content-Length"])])
    sizes = [output["parameters"]["binary_data_size"] for output in head["outputs"]]
    assert sizes == [2 * 16 * 8, 2 * 4, 2 * 4, 2 * 8, 2 * (4 + len("bracket"))]
    assert len(reply.body) == int(reply.headers["Inference-Header-Content-Length"]) + sum(sizes)


def test_tritons_config_and_statistics_are_true(start_server: Any, bundle_folder: Path, make_cloud: Any) -> None:
    server = start_server(bundle_folder)
    with triton_client(server.address) as client:
        config = client.get_model_config("bracket")
        assert (config["name"], config["max_batch_size"]) == ("bracket", 0)
        assert config["input"] == [{"name": "points", "data_type": "TYPE_FP32", "dims": [-1, 3]}]
        assert config["output"][0] == {"name": "camera_from_part", "data_type": "TYPE_FP64", "dims": [-1, 4, 4]}
        assert config["output"][-1] == {"name": "part", "data_type": "TYPE_STRING", "dims": [-1]}
        (before,) = client.get_inference_statistics()["model_stats"]
        assert (before["inference_count"], before["last_inference"]) == (0, 0)
        for _ in range(3):
            client.infer("bracket", [cloud_input(make_cloud(), True)])
        with pytest.raises(triton.InferenceServerException, match="were millimetres sent"):
            client.infer("bracket", [cloud_input(make_cloud() * 1000, True)])
        (after,) = client.get_inference_statistics("bracket", server.version())["model_stats"]
        assert (after["name"], after["version"]) == ("bracket", server.version())
        assert after["inference_count"] == after["execution_count"] == 3
        spent = after["inference_stats"]
        counts = {key: value["count"] for key, value in spent.items()}
        assert counts == {"success": 3, "fail": 1, "queue": 3, "compute_input": 3, "compute_infer": 3}
        assert 0 < spent["compute_infer"]["ns"] < spent["success"]["ns"]
        assert abs(after["last_inference"] / 1e3 - time.time()) < 60
        for ask in (client.get_model_config, client.get_inference_statistics):
            with pytest.raises(triton.InferenceServerException, match="got 'gear'") as caught:
                ask("gear")
            assert caught.value.status() == "404"
