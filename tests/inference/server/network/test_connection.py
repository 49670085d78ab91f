"""A connection's limits: the head of a request in time, an answer that is read, and nothing parsed after a refusal."""

from __future__ import annotations

import http.client
import os
import socket
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

TOKEN = "swordfish-" + "7" * 20
UPLOAD = b"POST /poses HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"


def connect(server: Any) -> socket.socket:
    host, port = server.address.split(":")
    return socket.create_connection((host, int(port)), timeout=20)


def all_of(connection: socket.socket) -> bytes:
    """Everything until the server ends the connection."""
    reply = b""
    with suppress(ConnectionResetError):
        while piece := connection.recv(65536):
            reply += piece
    return reply


def processor_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@pytest.fixture
def guarded_server(start_server: Any, bundle_folder: Path, tmp_path: Path) -> Any:
    """A server with a token."""
    token = tmp_path / "token"
    token.write_text(TOKEN)
    return start_server(bundle_folder, "--token-file", str(token))


@pytest.mark.slow
def test_heads_that_do_not_come_and_answers_that_are_not_read_end(start_server: Any, bundle_folder: Path) -> None:
    """All at the same time: each takes ten seconds."""
    server = start_server(bundle_folder)
    server.get("/v2")
    first = b"GET /v2 HTTP/1.1\r\nHost: localhost\r\n"
    replies: dict[str, tuple[bytes, float]] = {}

    def attempt(name: str, *pieces: bytes, drip: bytes = b"") -> None:
        begun = time.monotonic()
        with connect(server) as connection:
            for piece in pieces:
                connection.sendall(piece)
            if drip:
                connection.settimeout(0.5)
                with suppress(OSError):
                    while time.monotonic() - begun < 20:
                        with suppress(TimeoutError):
                            reply = connection.recv(65536)
                            connection.settimeout(5)
                            replies[name] = reply + all_of(connection), time.monotonic() - begun
                            return
                        connection.sendall(drip)
            replies[name] = all_of(connection), time.monotonic() - begun

    attempts = [
        threading.Thread(target=attempt, args=("silent",)),
        threading.Thread(target=attempt, args=("half", first)),
        threading.Thread(target=attempt, args=("dripping", first), kwargs={"drip": b"X: y\r\n"}),
        threading.Thread(target=attempt, args=("half of the second", first + b"\r\n", first)),
    ]
    for thread in attempts:
        thread.start()
    with connect(server) as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        with suppress(OSError):
            for _ in range(2000):  # 40 MB of answers that nobody reads
                deaf.settimeout(1)
                deaf.sendall(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n")
        server.wait_until(lambda: server.metric("connections_closed_total", reason="answer") == 1, "it was given up")
    for thread in attempts:
        thread.join(30)
    assert replies["silent"][0] == b""
    for name in ("half", "dripping"):
        assert replies[name][0].startswith(b"HTTP/1.1 408 ")
        assert (
            b"a request's line and headers must arrive within 10 s, but they did not: send them at once"
            in replies[name][0]
        )
    assert replies["half of the second"][0].startswith(b"HTTP/1.1 200 ")
    assert b"HTTP/1.1 408 " in replies["half of the second"][0]
    assert all(9 < seconds < 16 for _, seconds in replies.values()), replies
    assert server.metric("connections_closed_total", reason="head") == 4


def test_a_refused_upload_is_not_parsed_on(guarded_server: Any) -> None:
    with connect(guarded_server) as connection:
        connection.sendall(UPLOAD)
        time.sleep(0.2)
        before = processor_s(guarded_server.process.pid)
        for _ in range(60):
            connection.sendall(b"1\r\nx\r\n" * 10_000)
        connection.shutdown(socket.SHUT_WR)
        reply = all_of(connection)
        used = processor_s(guarded_server.process.pid) - before
    assert reply.startswith(b"HTTP/1.1 401 ")
    assert b"connection: close" in reply.lower()
    assert reply.count(b"HTTP/1.1") == 1
    assert used < 0.8  # parsed, these 3.6 MB took more than three seconds


@pytest.mark.parametrize(
    ("line", "status"),
    [
        (b"POST /pose", 404),
        (b"PUT /v2", 405),
        (b"POST /v2/models/gear/infer", 404),
        (b"GET /metrics", 200),  # reads no body
    ],
)
def test_an_answer_before_the_end_of_the_body_is_the_last(shared_server: Any, line: bytes, status: int) -> None:
    with connect(shared_server) as connection:
        connection.sendall(line + b" HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5000000\r\n\r\n")
        connection.sendall(b"GET /v2 HTTP/1.1\r\nHost: localhost\r\n\r\n" * 20)  # the body, which nobody may obey
        connection.shutdown(socket.SHUT_WR)
        reply = all_of(connection)
    assert reply.startswith(b"HTTP/1.1 %d " % status)
    assert b"connection: close" in reply.lower()
    assert reply.count(b"HTTP/1.1 ") == 1


def test_a_body_that_was_read_leaves_the_connection_open(shared_server: Any) -> None:
    with connect(shared_server) as connection:
        for _ in range(3):
            connection.sendall(b"POST /pose HTTP/1.1\r\nHost: localhost\r\nContent-Length: 2\r\n\r\nhi")
            reply = b""
            while not reply.endswith(b"}"):
                reply += connection.recv(65536)
            assert reply.startswith(b"HTTP/1.1 404 ")
            assert b"connection: close" not in reply.lower()


def test_an_accepted_client_s_small_chunks_are_refused(shared_server: Any) -> None:
    with connect(shared_server) as connection:
        connection.sendall(UPLOAD + b"1\r\nx\r\n" * 10_000)
        reply = all_of(connection)
    assert reply.startswith(b"HTTP/1.1 400 ")
    assert b"a body of more than 1024 chunks must have at least 256 bytes a chunk, got 1: send larger chunks" in reply
    assert shared_server.metric("connections_closed_total", reason="chunks") >= 1
    assert shared_server.metric("queue_depth") == 0


def test_what_is_no_http_gets_a_sentence(shared_server: Any) -> None:
    with connect(shared_server) as connection:
        connection.sendall(b"EHLO cell\r\n\r\n")
        reply = all_of(connection)
    assert reply.startswith(b"HTTP/1.1 400 ")
    assert b'{"error":"the request must be HTTP/1.1 with a line and headers of at most 64 KiB, but it is not"}' in reply


def test_answers_on_a_kept_connection_are_not_held_back(shared_server: Any) -> None:
    """Head and body are two packets; without TCP_NODELAY the second waits 40 ms for the first one's receipt."""
    connection = http.client.HTTPConnection(shared_server.address, timeout=10)
    seconds = []
    for _ in range(41):
        begun = time.monotonic()
        connection.request("GET", "/v2")
        assert connection.getresponse().read()
        seconds.append(time.monotonic() - begun)
    connection.close()
    assert sorted(seconds)[20] < 0.03
