"""Places of connections: how many there are, who gives way, and that nobody can be kept out."""

from __future__ import annotations

import resource
import socket
import time
from contextlib import ExitStack
from typing import Any

import pytest

from attentionvote.inference.server.metrics import Metrics
from attentionvote.inference.server.network.book import (
    HEALTH_CONNECTIONS,
    ConnectionBook,
    connection_limit,
    raise_handle_limit,
)
from attentionvote.inference.server.reception import MOST_AT_ONCE


class Connection:
    """A connection as the book sees it."""

    def __init__(self, silent_since: float, busy: bool = False) -> None:
        self.silent_since, self.busy, self.spare, self.ended = silent_since, busy, False, False

    def give_way(self) -> None:
        self.ended = True


@pytest.mark.parametrize(
    ("handles", "requests", "limit"),
    [(4096, 3, 256), (1024, 3, 256), (1024, 1001, 256), (400, 1001, 168), (128, 3, 61), (64, 3, 8), (16, 3, 8)],
)
def test_the_limit_follows_the_file_handles(handles: int, requests: int, limit: int) -> None:
    assert connection_limit(handles, requests) == limit


def test_the_soft_limit_is_raised_and_never_lowered() -> None:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(1024, before[1]), before[1]))
        assert raise_handle_limit() == min(4096, before[1])
        assert resource.getrlimit(resource.RLIMIT_NOFILE) == (min(4096, before[1]), before[1])
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert raise_handle_limit() >= before[0]
    assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] >= before[0]


def test_the_longest_silent_connection_without_a_request_gives_way() -> None:
    metrics = Metrics()
    book = ConnectionBook(3, metrics)
    busy, old, young, new = Connection(1.0, busy=True), Connection(2.0), Connection(3.0), Connection(4.0)
    for connection in (busy, young, old, new):
        assert book.admit(connection)
    assert [c.ended for c in (busy, old, young, new)] == [False, True, False, False]
    assert not book.health_only(new)
    assert metrics.registry.get_sample_value("attentionvote_connections") == 3
    assert metrics.registry.get_sample_value("attentionvote_connections_closed_total", {"reason": "silent"}) == 1


def test_where_all_are_busy_a_few_more_may_ask_about_health() -> None:
    book = ConnectionBook(2, Metrics())
    busy = [Connection(0.0, busy=True) for _ in range(2)]
    more = [Connection(1.0, busy=True) for _ in range(HEALTH_CONNECTIONS)]
    assert all(book.admit(connection) for connection in (*busy, *more))
    assert [book.health_only(connection) for connection in (*busy, *more)] == [False] * 2 + [True] * len(more)
    assert not book.admit(Connection(2.0))
    for connection in (*busy, *more[2:]):
        book.remove(connection)
    assert not book.health_only(more[0])


@pytest.mark.parametrize("handles", [1024, 128])
def test_silent_connections_keep_nobody_out(
    start_server: Any, bundle_folder: Any, make_cloud: Any, npy: Any, handles: int
) -> None:
    server = start_server(bundle_folder, handles=handles)
    host, port = server.address.split(":")
    body = npy(make_cloud())
    with ExitStack() as open_ones:
        for i in range(400):
            open_ones.enter_context(socket.create_connection((host, int(port)), timeout=10))
            if i % 100 == 99:
                assert server.get("/v2/health/live").status == 200
                assert server.post("/poses", body).status == 200
        most = connection_limit(handles, MOST_AT_ONCE + 3)
        assert server.metric("connections") == most
        assert server.metric("connections_closed_total", reason="silent") >= 400 - most
    warnings = [line for line in server.log() if line["level"] != "info"]
    assert [line["message"] for line in warnings] == [
        f"{most} connections are open: the longest silent one gives way to a new one"
    ]


def test_health_has_places_of_its_own(start_server: Any, bundle_folder: Any) -> None:
    server = start_server(bundle_folder, handles=64)
    host, port = server.address.split(":")
    head = b"POST /v2/repository/index HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\n"
    with ExitStack() as open_ones:
        for _ in range(8):  # each has a request in progress for five seconds
            open_ones.enter_context(socket.create_connection((host, int(port)), timeout=10)).sendall(head)
        time.sleep(0.5)  # all of them are read
        refused = server.get("/metrics")
        assert refused.status == 503
        assert refused.headers["Retry-After"] == "1"
        assert refused.error == "at most 8 connections may have a request in progress, and all have: try again shortly"
        assert server.get("/v2/health/live").status == 200
        assert server.get("/v2/health/ready").status == 200
    server.wait_until(lambda: server.get("/metrics").status == 200, "there are places again")
