"""Queue, deadlines and clients that leave, on a real server with a slow model."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest


@pytest.fixture
def slow_bundle(make_bundle: Callable[..., Path]) -> Path:
    """A bundle whose graph takes about half a second."""
    return make_bundle("slow", graph={"loops": 250_000})


def test_beyond_the_queue_is_503_and_nobody_else_suffers(
    start_server: Any, slow_bundle: Path, make_cloud: Any, npy: Any
) -> None:
    server = start_server(slow_bundle, "--queue", "1", "--deadline-ms", "30000")
    bodies = [npy(make_cloud(seed=i)) for i in range(5)]
    with ThreadPoolExecutor(5) as pool:
        replies = list(pool.map(lambda body: server.post("/poses", body), bodies))
    statuses = sorted(reply.status for reply in replies)
    assert statuses == [200, 200, 503, 503, 503]
    for reply in replies:
        if reply.status == 503:
            assert "at most 2 requests may run or wait" in reply.error
            assert int(reply.headers["Retry-After"]) >= 1
            assert int(reply.headers["X-Retry-After-Ms"]) > 0
        else:
            assert len(reply.json["poses"]) == 2
    assert server.metric("requests_total", outcome="overloaded") == 3
    assert server.metric("queue_depth") == 0
    assert server.post("/poses", bodies[0]).status == 200


def test_the_deadline_stops_the_work_and_frees_the_place(
    start_server: Any, make_bundle: Any, make_cloud: Any, npy: Any
) -> None:
    server = start_server(make_bundle(graph={"loops": 1_000_000}), "--queue", "0")
    body = npy(make_cloud())
    begun = time.monotonic()
    reply = server.post("/poses", body, {"X-Deadline-Ms": "100"})
    assert time.monotonic() - begun < 1.0  # the graph would take two seconds
    assert reply.status == 504
    assert reply.json["answer"] == "abstention"
    assert reply.json["reason"] == "deadline_exceeded"
    assert reply.json["poses"] == []
    assert "the deadline of 0." in reply.error
    # Cancelled for real: the only place is free at once.
    server.wait_until(lambda: server.metric("queue_depth") == 0, "the place is free", 0.5)
    assert server.metric("requests_total", outcome="deadline") == 1
    assert server.metric("abstentions_total", reason="deadline_exceeded") == 1


def test_waiting_counts_against_the_deadline(start_server: Any, slow_bundle: Path, make_cloud: Any, npy: Any) -> None:
    server = start_server(slow_bundle, "--deadline-ms", "30000")
    body = npy(make_cloud())
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(server.post, "/poses", body)
        server.wait_until(lambda: server.metric("queue_depth") == 1, "the first request runs")
        begun = time.monotonic()
        late = server.post("/poses", body, {"X-Deadline-Ms": "60"})
        assert time.monotonic() - begun < 0.4
        assert late.status == 504
        assert late.json["reason"] == "deadline_exceeded"
        assert "the deadline of 60 ms passed while the request waited" in late.error
        assert running.result().status == 200


@pytest.mark.parametrize("value", ["0", "-5", "nan", "inf", "60001", "soon", "1_000", "", "٣"])
def test_a_deadline_that_is_none_is_refused(shared_server: Any, make_cloud: Any, npy: Any, value: str) -> None:
    reply = shared_server.post("/poses", npy(make_cloud()), {"X-Deadline-Ms": value.encode().decode("latin-1")})
    assert reply.status == 400
    assert "X-Deadline-Ms must be" in reply.error


def test_a_body_that_never_ends_is_given_up_at_the_deadline(shared_server: Any) -> None:
    host, port = shared_server.address.split(":")
    with socket.create_connection((host, int(port)), timeout=10) as connection:
        connection.sendall(
            b"POST /poses HTTP/1.1\r\nHost: x\r\nX-Deadline-Ms: 150\r\nContent-Length: 5000\r\n\r\nhello"
        )
        reply = connection.recv(65536)
    assert reply.startswith(b"HTTP/1.1 504 ")
    assert b"the deadline of 150 ms passed while the body was received" in reply
    shared_server.wait_until(lambda: shared_server.metric("queue_depth") == 0, "the place is free")


def test_a_client_that_leaves_takes_its_queued_work_with_it(
    start_server: Any, slow_bundle: Path, make_cloud: Any, npy: Any
) -> None:
    server = start_server(slow_bundle, "--deadline-ms", "30000")
    body = npy(make_cloud())
    host, port = server.address.split(":")
    running = threading.Thread(target=server.post, args=("/poses", body))
    running.start()
    server.wait_until(lambda: server.metric("queue_depth") == 1, "the first request runs")
    with socket.create_connection((host, int(port)), timeout=10) as connection:
        connection.sendall(b"POST /poses HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n" % len(body) + body)
        server.wait_until(lambda: server.metric("queue_depth") == 2, "the second request waits")
    server.wait_until(lambda: server.metric("requests_total", outcome="gone") == 1, "the client's leaving is noticed")
    running.join()
    server.wait_until(lambda: server.metric("queue_depth") == 0, "everything has ended")
    assert server.metric("request_seconds_count", stage="estimate") == 1  # the second never ran
    gone = [line for line in server.log("request") if line["outcome"] == "gone"]
    assert [line["status"] for line in gone] == [499]
