"""Queue, deadlines and clients that leave, on a real server with a slow model."""

from __future__ import annotations

import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest


def test_beyond_the_queue_is_503_and_nobody_else_suffers(slow_server: Any, make_cloud: Any, npy: Any) -> None:
    server = slow_server
    before = server.metric("requests_total", outcome="overloaded")
    bodies = [npy(make_cloud(seed=i)) for i in range(5)]
    together = threading.Barrier(5)

    def ask(body: bytes) -> Any:
        together.wait(20)
        return server.post("/poses", body)

    with ThreadPoolExecutor(5) as pool:
        replies = list(pool.map(ask, bodies))
    statuses = [reply.status for reply in replies]
    assert set(statuses) == {200, 503}
    assert statuses.count(200) >= 2  # three and more only where this machine is slower than the model
    for reply in replies:
        if reply.status == 503:
            assert "at most 2 requests may run or wait" in reply.error
            assert int(reply.headers["Retry-After"]) >= 1
            assert int(reply.headers["X-Retry-After-Ms"]) > 0
        else:
            assert len(reply.json["poses"]) == 2
    assert server.metric("requests_total", outcome="overloaded") == before + statuses.count(503)
    assert server.metric("queue_depth") == 0
    assert server.post("/poses", bodies[0]).status == 200


def test_the_deadline_stops_the_work_and_frees_the_place(slow_server: Any, make_cloud: Any, npy: Any) -> None:
    server = slow_server
    before = server.metric("requests_total", outcome="deadline")
    body = npy(make_cloud())
    server.post("/poses", body)
    whole = max(line.get("stages_ms", {}).get("estimate", 0.0) for line in server.log("request"))
    begun = time.monotonic()
    reply = server.post("/poses", body, {"X-Deadline-Ms": "100"})
    assert time.monotonic() - begun < 0.6 * whole / 1e3
    assert reply.status == 504
    assert reply.json["answer"] == "abstention"
    assert reply.json["reason"] == "deadline_exceeded"
    assert reply.json["poses"] == []
    assert "the deadline of " in reply.error
    # Cancelled for real: nothing goes on in the background, the place is free at once.
    server.wait_until(lambda: server.metric("queue_depth") == 0, "the place is free", 1.0)
    assert server.metric("requests_total", outcome="deadline") == before + 1
    assert server.metric("abstentions_total", reason="deadline_exceeded") == before + 1


def test_waiting_counts_against_the_deadline(slow_server: Any, make_cloud: Any, npy: Any) -> None:
    server = slow_server
    body = npy(make_cloud())
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(server.post, "/poses", body)
        server.wait_until(lambda: server.metric("queue_depth") == 1, "the first request runs")
        begun = time.monotonic()
        late = server.post("/poses", body, {"X-Deadline-Ms": "60"})
        assert time.monotonic() - begun < 0.5
        assert late.status == 504
        assert late.json["reason"] == "deadline_exceeded"
        assert "the deadline of " in late.error
        assert running.result().status == 200


@pytest.mark.parametrize("value", ["0", "-5", "nan", "inf", "0.99", "soon", "1_000", "", "٣"])
def test_a_deadline_that_is_none_is_refused(shared_server: Any, make_cloud: Any, npy: Any, value: str) -> None:
    reply = shared_server.post("/poses", npy(make_cloud()), {"X-Deadline-Ms": value.encode().decode("latin-1")})
    assert reply.status == 400
    assert "X-Deadline-Ms must be" in reply.error


def test_a_body_that_never_ends_is_given_up_at_the_deadline(shared_server: Any) -> None:
    host, port = shared_server.address.split(":")
    with socket.create_connection((host, int(port)), timeout=10) as connection:
        head = b"POST /poses HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\nX-Deadline-Ms: 150\r\n"
        connection.sendall(head + b"Content-Length: 5000\r\n\r\nhello")
        reply = b""
        while piece := connection.recv(65536):
            reply += piece
    assert reply.startswith(b"HTTP/1.1 504 ")
    assert b"the deadline of 150 ms passed while the body was received" in reply
    shared_server.wait_until(lambda: shared_server.metric("queue_depth") == 0, "the place is free")


def test_a_client_that_leaves_takes_its_queued_work_with_it(slow_server: Any, make_cloud: Any, npy: Any) -> None:
    server = slow_server
    estimates = server.metric("request_seconds_count", stage="estimate")
    body = npy(make_cloud())
    host, port = server.address.split(":")
    running = threading.Thread(target=server.post, args=("/poses", body))
    running.start()
    server.wait_until(lambda: server.metric("queue_depth") == 1, "the first request runs")
    with socket.create_connection((host, int(port)), timeout=10) as connection:
        connection.sendall(b"POST /poses HTTP/1.1\r\nHost: localhost\r\nContent-Length: %d\r\n\r\n" % len(body) + body)
        server.wait_until(lambda: server.metric("queue_depth") == 2, "the second request waits")
    server.wait_until(lambda: server.metric("requests_total", outcome="gone") == 1, "the client's leaving is noticed")
    running.join()
    server.wait_until(lambda: server.metric("queue_depth") == 0, "everything has ended")
    assert server.metric("request_seconds_count", stage="estimate") == estimates + 1  # the second never ran
    gone = [line for line in server.log("request") if line["outcome"] == "gone"]
    assert [line["status"] for line in gone] == [499]
