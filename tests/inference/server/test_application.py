"""``/poses``, ``/metrics`` and ``/`` over HTTP, and fuzzed requests against a real server."""

from __future__ import annotations

import io
import json
import re
import socket
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from PIL import Image
from prometheus_client.parser import text_string_to_metric_families

PLY_HEADER = (
    "ply\nformat binary_little_endian 1.0\nelement vertex {n}\n"
    "property float x\nproperty float y\nproperty float z\nend_header\n"
)
PCD_HEADER = (
    "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {n}\nHEIGHT 1\n"
    "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n"
)


def without_time(answer: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in answer.items() if key != "seconds"}


def test_poses_of_every_kind_of_cloud_file_are_the_same(shared_server: Any, make_cloud: Any, npy: Any) -> None:
    cloud = make_cloud(seed=3)
    raw = cloud.astype("<f4").tobytes()
    bodies = [npy(cloud), *((h.format(n=len(cloud)).encode() + raw) for h in (PLY_HEADER, PCD_HEADER))]
    answers = [shared_server.post("/poses", body) for body in bodies]
    assert [reply.status for reply in answers] == [200, 200, 200]
    first, *others = [without_time(reply.json) for reply in answers]
    assert first["answer"] == "estimate"
    assert len(first["poses"]) == 2
    assert first["poses"][0]["confidence"] >= first["poses"][1]["confidence"]
    assert first["model"] == shared_server.version()
    assert others == [first, first]


def test_a_depth_image_becomes_poses_through_the_cells_camera(shared_server: Any) -> None:
    depth = np.full((120, 160), 800, np.uint16)  # millimetres: the camera's default scale
    depth[:, :40] = 0
    stream = io.BytesIO()
    Image.fromarray(depth).save(stream, "PNG")
    answer = shared_server.post("/poses", stream.getvalue())
    assert answer.status == 200
    assert answer.json["points_given"] == 120 * 160
    assert answer.json["points_used"] == 120 * 120
    # The tiny model's poses hang on the middle of its points: 20 pixels to the right of the image's.
    assert answer.json["poses"][1]["position"][2] == pytest.approx(0.8, abs=1e-3)
    assert answer.json["poses"][1]["position"][0] == pytest.approx(20 / 300 * 0.8, abs=0.02)


def test_an_empty_bin_is_an_answer(shared_server: Any, npy: Any) -> None:
    for shape in ((0, 3), (5, 3), (4, 4, 3)):
        reply = shared_server.post("/poses", npy(np.zeros(shape, np.float32)))  # zeros: missing points
        assert reply.status == 200
        assert reply.json["poses"] == []
        assert reply.json["reason"] == "too_few_points"


def refusals(cloud: np.ndarray, npy: Any) -> dict[str, tuple[bytes, int, str]]:
    picture = io.BytesIO()
    Image.new("RGB", (8, 8)).save(picture, "PNG")
    return {
        "nothing": (b"", 400, "the body must hold a cloud"),
        "text": (b"hello", 400, "the body must be a point cloud"),
        "json": (json.dumps({"points": cloud[:5].tolist()}).encode(), 400, "the body must be a point cloud"),
        "strays": (npy(cloud * np.float32(1e20)), 400, "points must be metres"),
        "millimetres": (npy(cloud * 1000), 400, "were millimetres sent? divide by 1000"),
        "whole numbers": (npy((cloud * 1000).astype(np.int32)), 400, "must be floating-point metres, got int32"),
        "five columns": (npy(np.zeros((9, 5), np.float32)), 400, "must have shape (P, 3)"),
        "pickle": (npy(np.array([{}], object)), 400, "does not describe an array of plain numbers"),
        "truncated": (npy(cloud)[:-1], 400, "needs 36000 bytes, got 35999"),
        "picture": (picture.getvalue(), 400, "must be a 16-bit grey PNG, got 8-bit RGB"),
        "too large": (
            npy(np.zeros((100_000, 3), np.float32)),
            413,
            "at most 1048576 bytes, got 1200128: crop the cloud",
        ),
        "behind": (npy(cloud * np.float32([1, -1, -1])), 400, "points must lie before the camera"),
    }


@pytest.mark.parametrize(
    "case",
    ["nothing", "text", "json", "strays", "millimetres", "whole numbers", "five columns", "pickle", "truncated",
     "picture", "too large", "behind"],
)  # fmt: skip
def test_bad_clouds_are_refused_in_one_sentence(shared_server: Any, make_cloud: Any, npy: Any, case: str) -> None:
    body, status, sentence = refusals(make_cloud(), npy)[case]
    reply = shared_server.post("/poses", body)
    assert reply.status == status
    assert sentence in reply.error
    assert "\n" not in reply.error
    assert set(reply.json) == {"error"}


def test_a_body_without_length_is_cut_off_at_the_limit(shared_server: Any) -> None:
    sent = 0

    def endless() -> Any:
        nonlocal sent
        for _ in range(64):
            sent += 65536
            yield b"\0" * 65536

    reply = shared_server.ask("POST", "/poses", endless())  # http.client sends it in chunks
    assert reply.status == 413
    assert "at most 1048576 bytes, got more" in reply.error


@pytest.mark.parametrize(
    ("method", "path", "status", "sentence"),
    [
        ("GET", "/poses", 405, "the method for /poses must be POST, got GET"),
        ("DELETE", "/v2/health/live", 405, "must be GET, HEAD, got DELETE"),
        ("POST", "/pose", 404, "got '/pose', did you mean '/poses'?"),
        ("GET", "/v2/", 404, "did you mean '/v2'?"),
        ("GET", "/v2/models/bracket/metadata/x", 404, "the path must be one that is served here"),
        ("GET", "/qqqqqq", 404, "got '/qqqqqq', see `attentionvote docs operating-a-cell`"),
        ("POST", "/poses?x=1", 400, "the body must hold a cloud"),
    ],
)
def test_wrong_paths_and_methods(shared_server: Any, method: str, path: str, status: int, sentence: str) -> None:
    reply = shared_server.ask(method, path)
    assert reply.status == status
    assert sentence in reply.error


def test_headers_without_end_are_refused(shared_server: Any) -> None:
    host, port = shared_server.address.split(":")
    with socket.create_connection((host, int(port)), timeout=10) as connection:
        with suppress(OSError):  # it hangs up before everything is sent
            for i in range(200):
                connection.sendall(f"{'GET /v2 HTTP/1.1' if i == 0 else f'X-{i}: ' + 'y' * 1000}\r\n".encode())
        with suppress(OSError):
            assert connection.recv(65536).startswith(b"HTTP/1.1 400 ")
    assert shared_server.get("/v2/health/live").status == 200


def test_the_front_page_says_what_is_served(shared_server: Any) -> None:
    content = shared_server.get("/").json
    assert content["model"]["version"] == shared_server.version()
    assert content["model"]["part"]["box"] == [[-0.05, -0.02, -0.01], [0.05, 0.02, 0.01]]
    assert content["documentation"] == "attentionvote docs operating-a-cell"
    for path in ("/poses", "/metrics", "/v2/models/MODEL/infer"):
        assert path in content["endpoints"]


def test_metrics_count_what_happened(start_server: Any, bundle_folder: Any, make_cloud: Any, npy: Any) -> None:
    server = start_server(bundle_folder)
    for body in (npy(make_cloud()), npy(make_cloud(seed=1)), npy(np.zeros((0, 3), np.float32)), b"nothing"):
        server.post("/poses", body)
    text = server.get("/metrics").body.decode()
    families = {family.name: family for family in text_string_to_metric_families(text)}
    assert server.metric("requests_total", outcome="ok") == 2
    assert server.metric("requests_total", outcome="abstained") == 1
    assert server.metric("requests_total", outcome="rejected") == 1
    assert server.metric("abstentions_total", reason="too_few_points") == 1
    assert server.metric("detections_count") == 3
    assert server.metric("detections_sum") == 4
    assert server.metric("detections_bucket", le="0.0") == 1
    for stage, count in (("receive", 4), ("queue", 4), ("parse", 3), ("estimate", 3)):
        assert server.metric("request_seconds_count", stage=stage) == count
    assert server.metric("request_seconds_count", stage="total") == 4
    assert (
        0 < server.metric("request_seconds_sum", stage="estimate") < server.metric("request_seconds_sum", stage="total")
    )
    assert server.metric("queue_depth") == 0
    assert server.metric("ready") == 1
    assert server.metric("last_known_good_kept") == 1
    assert server.metric("serving_last_known_good") == 0
    assert server.metric("reload_failing") == 0
    assert server.metric("reloads_total", outcome="loaded") == 1
    assert server.metric("peak_memory_bytes") > 1e7
    labels = families["attentionvote_model_info"].samples[0].labels
    assert labels["part"] == "bracket"
    assert labels["version"] == server.version() == labels["digest"][:12]
    assert not [line for line in text.splitlines() if not re.match(r"#|attentionvote_", line)]
    # This server has no cell file.
    stream = io.BytesIO()
    Image.fromarray(np.full((20, 20), 800, np.uint16)).save(stream, "PNG")
    reply = server.post("/poses", stream.getvalue())
    assert reply.status == 400
    assert reply.error == "a depth image needs its camera, got none: start the server with --cell and a camera in it"


def test_hundreds_of_fuzzed_requests_leave_the_server_answering(
    shared_server: Any, make_cloud: Any, npy: Any, infer_body: Any
) -> None:
    rng = np.random.default_rng(7)
    cloud = make_cloud(400)
    body, headers = infer_body(cloud)
    good = [(b"POST /v2/models/bracket/infer", body, headers)]
    good += [
        (b"POST /poses", npy(cloud), {}),
        (b"POST /poses", PLY_HEADER.format(n=400).encode() + cloud.tobytes(), {}),
    ]
    host, port = shared_server.address.split(":")
    answered = 0
    for i in range(250):
        line, content, extra = good[i % len(good)]
        lines = [line + b" HTTP/1.1", b"Connection: close", b"X-Deadline-Ms: 200", b"Host: localhost"]
        lines += [b"Content-Length: %d" % len(content)]
        lines += [f"{name}: {value}".encode() for name, value in extra.items()]
        message = bytearray(b"\r\n".join(lines) + b"\r\n\r\n" + content)
        # Half of them are damaged in the head of the body, where parsers decide, the rest anywhere.
        start = len(message) - len(content)
        for _ in range(rng.integers(1, 5)):
            at = int(rng.integers(start, start + 200) if rng.integers(2) else rng.integers(len(message)))
            message[at] = int(rng.integers(256))
        if rng.integers(16) == 0:
            del message[int(rng.integers(len(message))) :]
        with socket.create_connection((host, int(port)), timeout=0.5) as connection:
            connection.sendall(message)
            reply = b""
            with suppress(TimeoutError):  # half a head: the server waits for the rest
                reply = connection.recv(65536)
        if reply:
            status = int(reply.split(b" ", 2)[1])
            assert status in (200, 400, 404, 405, 413, 415, 421, 504), reply
            answered += 1
    assert answered > 220
    assert shared_server.metric("requests_total", outcome="failed") == 0
    assert shared_server.post("/poses", npy(make_cloud())).json["answer"] == "estimate"
