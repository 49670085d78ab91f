"""The client against real servers: its answers, its patience, its errors."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from attentionvote.inference.answer import Estimate
from attentionvote.inference.client.pose_client import (
    DeadlinePassed,
    PoseClient,
    Rejected,
    ServerFailed,
    Unauthorized,
    Unavailable,
    Unreachable,
)
from attentionvote.inference.estimator import PoseEstimator

TOKEN = "correct-horse-battery"


@contextmanager
def serving(bundle: Path, key: Path, folder: Path, *options: str) -> Iterator[str]:
    """The address of a real server in a process of its own."""
    words = [str(bundle), "--key", str(key), "--port", "0", "--state", str(folder / "state"), *options]
    with (folder / "server.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "attentionvote.inference.command_line", "serve", *words],
            stdout=subprocess.PIPE,
            stderr=log,
        )
    try:
        assert process.stdout is not None
        yield str(json.loads(process.stdout.readline())["url"])
    finally:
        process.terminate()
        assert process.wait(30) == 0
        assert process.stdout is not None
        process.stdout.close()


@contextmanager
def scripted(*answers: bytes | None) -> Iterator[str]:
    """A server that sends these bytes, one a connection, whatever it is asked; None: it hangs up."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def answer() -> None:
            for content in answers:
                connection, _ = listener.accept()
                with connection:
                    connection.settimeout(10)
                    connection.recv(1 << 20)
                    if content is not None:
                        connection.sendall(content)

        thread = threading.Thread(target=answer)
        thread.start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        thread.join(20)
        assert not thread.is_alive()


def http(status: str, body: bytes, *headers: str) -> bytes:
    lines = [f"HTTP/1.1 {status}", f"Content-Length: {len(body)}", "Connection: close", *headers]
    return "\r\n".join(lines).encode() + b"\r\n\r\n" + body


def test_answers_tokens_and_refusals(
    bundle_folder: Path, trusted_key: Path, make_cloud: Callable[..., Any], tmp_path: Path
) -> None:
    token = tmp_path / "token"
    token.write_text(TOKEN)
    cloud = make_cloud(seed=4)
    with PoseEstimator(bundle_folder, trusted=trusted_key) as estimator:
        expected = estimator.estimate(cloud)
    assert isinstance(expected, Estimate)
    large = np.full((2_000_000, 3), 0.8, np.float32)
    options = ("--token-file", str(token), "--max-body-mb", "1")
    with serving(bundle_folder, trusted_key, tmp_path, *options) as url:
        with PoseClient(url, token=TOKEN) as client:
            # Asked before the model is ready: it waits for it.
            answer = client.estimate(cloud)
            np.testing.assert_array_equal(answer.camera_from_part, [d.camera_from_part for d in expected.detections])
            np.testing.assert_array_equal(answer.confidence, np.float32([d.confidence for d in expected.detections]))
            assert (answer.status, answer.message, answer.part) == ("ok", "", "bracket")
            assert answer.version == expected.model
            assert answer.to_dict()["poses"][0]["camera_from_part"] == expected.detections[0].camera_from_part.tolist()
            np.testing.assert_array_equal(client.estimate(cloud.astype(np.float64)).confidence, answer.confidence)
            assert client.ready()
            assert client.metadata()["model"]["part"]["diameter"] == 0.1

            empty = client.estimate(np.zeros((0, 3), np.float32))
            assert empty.status == "too_few_points"
            assert empty.camera_from_part.shape == (0, 4, 4)
            with pytest.raises(Rejected, match="were millimetres sent"):
                client.estimate(cloud * 1000)
            # Refused before it was received: the sentence arrives all the same, and the connection is still good.
            with pytest.raises(Rejected, match="the body must have at most 1048576 bytes, got 24000"):
                client.estimate(large)
            client.estimate(cloud)
            with pytest.raises(DeadlinePassed, match="deadline"):
                client.estimate(cloud, deadline_ms=1)
        with PoseClient(url, token="wrong-" + TOKEN) as client:
            with pytest.raises(Unauthorized, match=r"must be 'Bearer' and the token .* got another token"):
                client.estimate(cloud)
            with pytest.raises(Unauthorized):
                client.metadata()
        with PoseClient(url, token="wrong-" + TOKEN, part="bracket") as client:
            with pytest.raises(Unauthorized, match="got another token"):
                client.estimate(large)
            assert client.ready()  # health is open
        told = pytest.raises(Rejected, match="got 'braket', did you mean 'bracket'")
        with PoseClient(url, token=TOKEN, part="braket") as client, told:
            client.estimate(cloud)
    with PoseClient(url, token=TOKEN) as client:
        assert not client.ready()
        with pytest.raises(Unreachable, match=r"cannot be reached: .*refused"):
            client.estimate(cloud)


def test_many_clients_wait_for_a_place_within_their_deadline(
    make_bundle: Callable[..., Path], trusted_key: Path, make_cloud: Callable[..., Any], tmp_path: Path
) -> None:
    bundle = make_bundle(graph={"loops": 50_000})
    with serving(bundle, trusted_key, tmp_path, "--queue", "0") as url:

        def ask(seed: int) -> int:
            with PoseClient(url, timeout_s=30) as client:
                return len(client.estimate(make_cloud(seed=seed)).confidence)

        with ThreadPoolExecutor(4) as pool:
            assert list(pool.map(ask, range(8))) == [2] * 8


def test_a_503_is_asked_again_when_the_server_says() -> None:
    busy = http(
        "503 Service Unavailable", b'{"error": "all places are taken"}', "X-Retry-After-Ms: 120", "Retry-After: 9"
    )
    with (
        scripted(busy, busy, http("404 Not Found", b'{"error": "at last"}')) as url,
        PoseClient(url, part="x") as client,
    ):
        begun = time.monotonic()
        with pytest.raises(Rejected, match="at last"):
            client.estimate(np.zeros((1, 3)), deadline_ms=8000)
        assert 0.24 < time.monotonic() - begun < 5
    with (
        scripted(http("503 Busy", b'{"error": "taken"}', "Retry-After: 9")) as url,
        PoseClient(url, part="x") as client,
    ):
        begun = time.monotonic()
        with pytest.raises(Unavailable, match="taken"):  # nine seconds are beyond the deadline
            client.estimate(np.zeros((1, 3)), deadline_ms=2000)
        assert time.monotonic() - begun < 1


def test_a_kept_connection_that_was_closed_is_replaced_once() -> None:
    good = http("200 OK", b'{"model": null}').replace(b"Connection: close\r\n", b"")
    with scripted(good, good) as url, PoseClient(url) as client:
        assert client.metadata() == {"model": None}
        assert client.metadata() == {"model": None}
    with scripted(None) as url, PoseClient(url) as client, pytest.raises(Unreachable, match="cannot be reached"):
        client.metadata()


@pytest.mark.parametrize(
    ("answer", "kind", "sentence"),
    [
        (http("200 OK", b"<html>"), ServerFailed, "must hold poses as binary tensors"),
        (
            http("200 OK", b"{}", "Inference-Header-Content-Length: 2"),
            ServerFailed,
            "must hold poses as binary tensors",
        ),
        (http("500 Oops", b'{"error": "internal error"}'), ServerFailed, "internal error"),
        (http("502 Bad Gateway", b"<html>"), ServerFailed, "status 502 and no sentence"),
        (http("413 Too Large", b'{"error": "too large"}'), Rejected, "too large"),
        (http("504 Late", b'{"error": "too late"}'), DeadlinePassed, "too late"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 50\r\n\r\nhalf", Unreachable, "cannot be reached"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 99999999999\r\n\r\n", ServerFailed, "at most 67108864 bytes"),
        (b"SSH-2.0-OpenSSH\r\n", Unreachable, "cannot be reached"),
    ],
)
def test_answers_that_are_none(answer: bytes, kind: type[Exception], sentence: str) -> None:
    with scripted(answer) as url, PoseClient(url, part="bracket") as client, pytest.raises(kind, match=sentence):
        client.estimate(np.zeros((1, 3), np.float32))


def test_silence_ends_with_the_deadline() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        client = PoseClient(f"http://127.0.0.1:{listener.getsockname()[1]}", part="x")
        begun = time.monotonic()
        with pytest.raises(DeadlinePassed, match="did not answer within"):
            client.estimate(np.zeros((1, 3)), deadline_ms=100)
        assert time.monotonic() - begun < 3


@pytest.mark.parametrize("url", ["127.0.0.1:8000", "http://", "ftp://x", "http://x/poses", "http://x?y"])
def test_no_address(url: str) -> None:
    with pytest.raises(ValueError, match="url must be http://HOST:PORT"):
        PoseClient(url)


@pytest.mark.parametrize("points", [np.zeros(3), np.zeros((2, 4)), np.zeros((2, 3), int), [["a", "b", "c"]]])
def test_no_cloud(points: Any) -> None:
    with PoseClient("http://127.0.0.1:1") as client, pytest.raises(ValueError, match="points must be floating-point"):
        client.estimate(points)


def test_impossible_times() -> None:
    with pytest.raises(ValueError, match="timeout_s must be positive seconds, got 0"):
        PoseClient("http://127.0.0.1:1", timeout_s=0)
    with PoseClient("http://127.0.0.1:1") as client, pytest.raises(ValueError, match="deadline_ms must be positive"):
        client.estimate(np.zeros((1, 3)), deadline_ms=float("nan"))


def test_the_client_needs_numpy_and_the_standard_library_only() -> None:
    program = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("onnxruntime", "scipy", "cryptography", "PIL", "starlette", "uvicorn", "torch"):
            raise ImportError(name)
sys.meta_path.insert(0, Blocked())
import attentionvote.inference.client.pose_client
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 0, done.stderr


def test_a_server_of_version_0_1_says_no_parts() -> None:
    """Its answer has three outputs: every pose is of the model's part."""
    arrays = {
        "camera_from_part": ("FP64", np.stack([np.eye(4)] * 2)),
        "confidence": ("FP32", np.float32([0.9, 0.8])),
        "heat": ("FP32", np.float32([4, 3])),
    }
    outputs = [
        {"name": n, "datatype": d, "shape": list(a.shape), "parameters": {"binary_data_size": a.nbytes}}
        for n, (d, a) in arrays.items()
    ]
    said = {"status": "ok", "message": "", "warnings": "", "part": "gear", "frame": "camera", "units": "m"}
    head = json.dumps({"model_version": "12ab", "parameters": said, "outputs": outputs}).encode()
    body = head + b"".join(array.tobytes() for _, array in arrays.values())
    old = http("200 OK", body, f"Inference-Header-Content-Length: {len(head)}")
    with scripted(old) as url, PoseClient(url, part="gear") as client:
        answer = client.estimate(np.zeros((1, 3), np.float32))
    assert answer.part_names == ("gear", "gear")
    assert answer.class_index.tolist() == [0, 0]
    assert [pose["part"] for pose in answer.to_dict()["poses"]] == ["gear", "gear"]


@pytest.mark.parametrize("packed", [b"\xff\xff\xff\x7fbolt", b"\4\0\0\0bol", b"\1\0\0\0\xff", b"\1\0"])
def test_texts_that_are_none(packed: bytes) -> None:
    part = {"name": "part", "datatype": "BYTES", "shape": [1], "parameters": {"binary_data_size": len(packed)}}
    head = json.dumps({"model_version": "1", "parameters": {}, "outputs": [part]}).encode()
    answer = http("200 OK", head + packed, f"Inference-Header-Content-Length: {len(head)}")
    with (
        scripted(answer) as url,
        PoseClient(url, part="x") as client,
        pytest.raises(ServerFailed, match="must hold poses as binary tensors"),
    ):
        client.estimate(np.zeros((1, 3), np.float32))
