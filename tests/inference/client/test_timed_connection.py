"""A call's time is the call's: however the bytes come, it ends a second after its deadline at the latest."""

from __future__ import annotations

import json
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from attentionvote.inference.client.pose_client import DeadlinePassed, PoseClient, ServerFailed, Unreachable

OK = b"HTTP/1.1 200 OK\r\n"
GOOD = b'{"model": null}'


@contextmanager
def answering(answer: Callable[[socket.socket], None], tls: ssl.SSLContext | None = None) -> Iterator[str]:
    """A server that answers one connection."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def run() -> None:
            connection, _ = listener.accept()
            with connection, suppress(OSError):
                connection.settimeout(10)
                if tls is None:
                    connection.recv(1 << 16)
                    answer(connection)
                    return
                with tls.wrap_socket(connection, server_side=True) as wrapped:
                    wrapped.recv(1 << 16)
                    answer(wrapped)

        thread = threading.Thread(target=run)
        thread.start()
        yield f"{'http' if tls is None else 'https'}://127.0.0.1:{listener.getsockname()[1]}"
        thread.join(20)
        assert not thread.is_alive()


def dripping(first: bytes, drop: bytes) -> Callable[[socket.socket], None]:
    """Sends something, and then a little every tenth of a second, as long as anybody listens."""

    def answer(connection: socket.socket) -> None:
        connection.sendall(first)
        for _ in range(80):
            time.sleep(0.1)
            connection.sendall(drop)

    return answer


def silent(connection: socket.socket) -> None:
    """Reads nothing more and says nothing for four seconds."""
    time.sleep(4)
    connection.close()


@pytest.mark.parametrize(
    ("answer", "points"),
    [
        (dripping(OK, b"X: y\r\n"), 1),
        (dripping(b"", b"H"), 1),
        (dripping(OK + b"Content-Length: 9000\r\n\r\n", b"x"), 1),
        (dripping(OK + b"Transfer-Encoding: chunked\r\n\r\n", b"1\r\nx\r\n"), 1),
        (dripping(b"", b"HTTP/1.1 100 Continue\r\n\r\n"), 1),
        (silent, 4_000_000),  # 48 MB that do not fit into the buffers of any kernel
    ],
    ids=["header lines", "status line", "body", "chunks", "continue", "nobody reads"],
)
def test_nothing_outlasts_the_deadline_by_more_than_a_second(
    answer: Callable[[socket.socket], None], points: int
) -> None:
    cloud = np.zeros((points, 3), np.float32)
    with answering(answer) as url, PoseClient(url, part="x") as client:
        begun = time.monotonic()
        with pytest.raises(DeadlinePassed, match="did not answer within the deadline"):
            client.estimate(cloud, deadline_ms=300)
        assert 0.3 < time.monotonic() - begun < 2.0


def test_the_same_over_tls(certificate: Any, tmp_path: Path) -> None:
    cert, key = certificate(tmp_path)
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    tls.load_cert_chain(cert, key)
    with (
        answering(dripping(OK + b"Content-Length: 9000\r\n\r\n", b"x"), tls) as url,
        PoseClient(url, part="x", ca_file=cert) as client,
    ):
        begun = time.monotonic()
        with pytest.raises(DeadlinePassed):
            client.estimate(np.zeros((1, 3)), deadline_ms=300)
        assert time.monotonic() - begun < 2.0


def test_calls_without_a_deadline_have_the_client_s() -> None:
    with answering(dripping(OK, b"X: y\r\n")) as url, PoseClient(url, timeout_s=0.4) as client:
        begun = time.monotonic()
        assert not client.ready()
        assert 0.3 < time.monotonic() - begun < 1.0


def test_chunks_of_a_proxy_are_read() -> None:
    pieces = [GOOD[:4], GOOD[4:]]
    chunks = b"".join(b"%x\r\n%b\r\n" % (len(piece), piece) for piece in pieces) + b"0\r\n\r\n"

    def answer(connection: socket.socket) -> None:
        connection.sendall(OK + b"Transfer-Encoding: chunked\r\n\r\n" + chunks)
        connection.recv(1 << 16)  # the second request comes on the same connection
        connection.sendall(OK + b"Content-Length: %d\r\n\r\n" % len(GOOD) + GOOD)

    with answering(answer) as url, PoseClient(url) as client:
        assert client.metadata() == json.loads(GOOD)
        assert client.metadata() == json.loads(GOOD)


def test_an_answer_that_ends_with_its_connection_is_read() -> None:
    with (
        answering(lambda connection: connection.sendall(OK + b"Connection: close\r\n\r\n" + GOOD)) as url,
        PoseClient(url) as client,
    ):
        assert client.metadata() == json.loads(GOOD)


def test_chunks_without_end_are_refused() -> None:
    chunk = b"100000\r\n" + b" " * 0x100000 + b"\r\n"

    def answer(connection: socket.socket) -> None:
        connection.sendall(OK + b"Transfer-Encoding: chunked\r\n\r\n")
        for _ in range(200):
            connection.sendall(chunk)

    with answering(answer) as url, PoseClient(url) as client, pytest.raises(ServerFailed, match="at most 67108864 byt"):
        client.metadata()


def test_half_a_chunk_is_no_answer() -> None:
    broken = OK + b"Transfer-Encoding: chunked\r\n\r\n10\r\nhalf"
    with (
        answering(lambda connection: connection.sendall(broken)) as url,
        PoseClient(url) as client,
        pytest.raises(Unreachable, match="cannot be reached"),
    ):
        client.metadata()
