"""Bodies on their way in: whoever only drips keeps nobody out."""

from __future__ import annotations

import socket
import time
from contextlib import ExitStack
from typing import Any


def start_body(stack: ExitStack, server: Any, size: int, sent: bytes = b"") -> socket.socket:
    """A request whose body has just begun."""
    host, port = server.address.split(":")
    connection = stack.enter_context(socket.create_connection((host, int(port)), timeout=20))
    head = f"POST /poses HTTP/1.1\r\nHost: localhost\r\nX-Deadline-Ms: 9000\r\nContent-Length: {size}\r\n\r\n"
    connection.sendall(head.encode() + sent)
    return connection


def answer_on(connection: socket.socket) -> bytes:
    """Head and body of a refusal."""
    answer = b""
    while not answer.endswith(b"}"):
        piece = connection.recv(65536)
        assert piece, answer
        answer += piece
    return answer


def test_stalled_bodies_take_no_places(shared_server: Any, make_cloud: Any, npy: Any) -> None:
    """More of them than may run and wait: before, three kept everybody out for as long as their deadlines."""
    with ExitStack() as stack:
        for _ in range(20):
            start_body(stack, shared_server, 5000, b"hello")
        time.sleep(0.2)
        begun = time.monotonic()
        reply = shared_server.post("/poses", npy(make_cloud()))
        assert time.monotonic() - begun < 2
        assert reply.status == 200
        assert shared_server.metric("queue_depth") == 0


def test_the_oldest_gives_way_when_too_many_come(shared_server: Any, make_cloud: Any, npy: Any) -> None:
    with ExitStack() as stack:
        first = start_body(stack, shared_server, 5000, b"x")
        time.sleep(0.1)
        others = [start_body(stack, shared_server, 5000, b"x") for _ in range(32)]
        answer = answer_on(first)
        assert answer.startswith(b"HTTP/1.1 503 ")
        assert b"the body must come as fast as others do" in answer
        others[-1].sendall(bytes(4999))
        assert answer_on(others[-1]).startswith(b"HTTP/1.1 400 ")
        assert shared_server.post("/poses", npy(make_cloud())).status == 200


def test_the_bytes_of_all_together_are_bounded(shared_server: Any, make_cloud: Any, npy: Any) -> None:
    """The server takes bodies of one MiB; of five that lack a byte each, the first has to go."""
    size = 1024 * 1024
    with ExitStack() as stack:
        first = start_body(stack, shared_server, size, bytes(size - 1))
        time.sleep(0.2)
        for _ in range(4):
            start_body(stack, shared_server, size, bytes(size - 1))
        assert answer_on(first).startswith(b"HTTP/1.1 503 ")
        assert shared_server.post("/poses", npy(make_cloud())).status == 200
