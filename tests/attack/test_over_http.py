"""A real server and bodies that want to become large, slow or endless: the next request is answered all the same."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from attackers import bomb_bodies, child_processes

# Within this time after anything an input does, everybody else is answered again.
AGAIN_S = 3.0


@pytest.fixture(scope="module")
def bodies() -> dict[str, bytes]:
    """Every bomb by name."""
    return bomb_bodies()


@pytest.mark.parametrize(
    ("name", "status", "sentence"),
    [
        ("strays", 200, ""),
        ("half strays", 400, "points must be metres"),
        ("one place", 200, ""),
        ("subnormal", 400, "points must be metres"),
        ("four million", 200, ""),
        ("lzma", 400, "the body must be a point cloud"),
        ("bzip2", 400, "the body must be a point cloud"),
        ("deflated", 400, "must unpack to at most"),
        ("two headers", 400, "must have one PNG header"),
        ("literals", 200, ""),
    ],
)
def test_no_body_keeps_the_next_one_waiting(
    attacked_server: Any, bodies: dict[str, bytes], make_cloud: Any, npy: Any, name: str, status: int, sentence: str
) -> None:
    good = npy(make_cloud())
    expected = attacked_server.post("/poses", good).json["poses"]
    begun = time.monotonic()
    reply = attacked_server.post("/poses", bodies[name], {"X-Deadline-Ms": "8000"})
    after = attacked_server.post("/poses", good)
    assert time.monotonic() - begun < AGAIN_S
    assert reply.status == status, reply.body[:300]
    assert sentence in reply.json.get("error", "")
    assert after.json["poses"] == expected
    assert attacked_server.get("/v2/health/ready").status == 200
    assert attacked_server.metric("ready") == 1


@pytest.mark.parametrize(
    ("head", "headers", "sentence"),
    [
        ({"outputs": [{"name": "abcdefgh" * 900_000}]}, {}, "an output must be one of"),
        ({"inputs": [{"name": "abcdefgh" * 900_000}]}, {}, "the input must be named 'points'"),
        ({}, {"Inference-Header-Content-Length": "\xff" * 30_000}, "must be a whole number of bytes"),
        ({"inputs": [{"name": "points", "datatype": "FP32", "shape": [int("9" * 4000), 3]}]}, {}, "must have shape"),
    ],
    ids=["output", "input", "header", "shape"],
)
def test_odd_requests_are_one_sentence_each(
    attacked_server: Any, head: dict[str, Any], headers: dict[str, str], sentence: str
) -> None:
    tensor = {"name": "points", "datatype": "FP32", "shape": [1, 3], "data": [0.0, 0.0, 0.8]}
    content = {"inputs": [tensor]} | head
    begun = time.monotonic()
    reply = attacked_server.post("/v2/models/bracket/infer", json.dumps(content).encode(), headers)
    assert time.monotonic() - begun < 2
    assert (reply.status, len(reply.error) < 500) == (400, True)
    assert sentence in reply.error
    assert attacked_server.get("/v2/health/ready").status == 200


@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGSEGV, signal.SIGKILL])
def test_whatever_happens_to_the_workers_a_request_is_answered_again(
    attacked_server: Any, make_cloud: Any, npy: Any, number: int
) -> None:
    body = npy(make_cloud())
    before = attacked_server.post("/poses", body).json["poses"]
    for worker in child_processes(attacked_server.process.pid):
        os.kill(worker, number)
    begun = time.monotonic()
    while (reply := attacked_server.post("/poses", body, {"X-Deadline-Ms": "1000"})).status != 200:
        assert reply.status in (503, 504)
        assert time.monotonic() - begun < 2 * AGAIN_S + 2  # both at once: a deadline, a second, and a start
    assert reply.json["poses"] == before
    attacked_server.wait_until(lambda: len(child_processes(attacked_server.process.pid)) == 2, "both are there again")


def test_an_update_that_never_ends_is_refused_and_the_next_one_taken(
    start_server: Any, make_bundle: Callable[..., Path], tmp_path: Path
) -> None:
    first, endless = make_bundle("first"), make_bundle("endless", graph={"loops": 10**15})
    good = make_bundle("good", graph={"confidence": (0.7, 0.9, 0.3, 0.99)})
    link = tmp_path / "latest"
    link.symlink_to(first)
    server = start_server(link, "--self-test-s", "2")
    version = server.version()
    for folder, done, what in (
        (endless, lambda: server.metric("reload_failing") == 1, "the endless one is refused"),
        (good, lambda: server.version() not in ("", version), "the good one serves"),
    ):
        (tmp_path / "next").symlink_to(folder)
        (tmp_path / "next").replace(link)
        server.wait_until(done, what)
        assert server.post("/v2/repository/index").json[0]["state"] == "READY"
        if folder is endless:
            assert "the self-test must end within 2 s" in server.reload_error()
            assert server.version() == version


def test_a_bundle_of_version_0_1_answers_as_it_did(
    start_server: Any, make_bundle: Callable[..., Path], make_cloud: Any, npy: Any, tmp_path: Path
) -> None:
    """Its golden poses, which were written by an estimator, come back to the bit over HTTP."""
    import numpy as np

    folder = make_bundle()
    golden = np.load(folder / "golden" / "cloud_0.npz")
    kept = tmp_path / "copy"
    shutil.copytree(folder, kept)
    server = start_server(kept)
    poses = server.post("/poses", npy(golden["points"])).json["poses"]
    np.testing.assert_array_equal([pose["camera_from_part"] for pose in poses], golden["camera_from_part"])
    assert json.loads((kept / "card.json").read_text())["contract_version"] == 1
    assert make_cloud().shape == golden["points"].shape
