"""The end of a connection: the client gets its answer while it is still sending, and not for ever."""

from __future__ import annotations

import asyncio
import socket
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from attentionvote.inference.client.pose_client import PoseClient, Rejected
from attentionvote.inference.server.network import transport


class Inner(asyncio.Transport):
    """A transport that writes down what is done to it."""

    def __init__(self) -> None:
        super().__init__()
        self.done: list[str] = []

    def __getattribute__(self, name: str) -> Any:
        if name in ("close", "abort", "resume_reading", "write_eof"):
            return lambda: self.done.append(name)
        return super().__getattribute__(name)

    def can_write_eof(self) -> bool:
        return True

    def get_write_buffer_size(self) -> int:
        return 0

    def is_closing(self) -> bool:
        return False


def test_with_nothing_to_come_it_closes_at_once() -> None:
    async def run() -> list[str]:
        inner = Inner()
        outer = transport.LingeringTransport(inner, lambda: False)
        outer.close()
        outer.close()
        assert outer.is_closing()
        outer.lost()
        return inner.done

    assert asyncio.run(run()) == ["close"]


def test_with_more_to_come_it_ends_its_own_side_and_then_itself(monkeypatch: Any) -> None:
    monkeypatch.setattr(transport, "LINGER_S", 0.05)

    async def run() -> list[str]:
        inner = Inner()
        outer = transport.LingeringTransport(inner, lambda: True)
        outer.close()
        outer.drop(1000)
        assert inner.done == ["resume_reading", "write_eof"]
        await asyncio.sleep(0.1)
        return inner.done

    assert asyncio.run(run())[2:] == ["abort"]


def test_more_than_a_gibibyte_is_not_waited_for() -> None:
    async def run() -> list[str]:
        inner = Inner()
        outer = transport.LingeringTransport(inner, lambda: True)
        outer.close()
        outer.drop(1024**3)
        assert "abort" not in inner.done
        outer.drop(1)
        outer.lost()
        return inner.done

    assert asyncio.run(run())[-1] == "abort"


def test_the_answer_arrives_while_a_large_body_is_sent(shared_server: Any) -> None:
    for _ in range(5):
        reply = shared_server.post("/poses", b"\0" * 30_000_000)
        assert reply.status == 413
        assert "at most 1048576 bytes, got 30000000" in reply.error


def test_the_answer_arrives_over_tls_as_well(
    start_server: Any, bundle_folder: Path, tmp_path: Path, certificate: Any
) -> None:
    cert, key = certificate(tmp_path)
    options = ("--tls-cert", str(cert), "--tls-key", str(key), "--max-body-mb", "1")
    server = start_server(bundle_folder, *options, ready=False)
    with PoseClient(server.url, ca_file=cert, part="bracket") as client:
        server.wait_until(client.ready, "it is ready")
        for _ in range(3):
            begun = time.monotonic()
            with pytest.raises(Rejected, match="the body must have at most 1048576 bytes, got 24000"):
                client.estimate(np.full((2_000_000, 3), 0.8, np.float32))
            assert time.monotonic() - begun < 8
        assert client.ready()


@pytest.mark.slow
def test_a_client_that_goes_on_sending_is_cut_off(shared_server: Any) -> None:
    host, port = shared_server.address.split(":")
    begun = time.monotonic()
    with socket.create_connection((host, int(port)), timeout=20) as connection:
        connection.sendall(b"POST /pose HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000000\r\n\r\n")
        with suppress(OSError):
            while time.monotonic() - begun < 20:
                connection.sendall(b"x")
                time.sleep(0.2)
    assert 9 < time.monotonic() - begun < 15


def test_the_server_s_end_does_not_wait_for_what_is_dropped(start_server: Any, bundle_folder: Path) -> None:
    server = start_server(bundle_folder)
    host, port = server.address.split(":")
    with socket.create_connection((host, int(port)), timeout=20) as connection:
        connection.sendall(b"POST /pose HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000000\r\n\r\n")
        assert connection.recv(12) == b"HTTP/1.1 404"
        begun = time.monotonic()
        assert server.stop() == 0
        assert time.monotonic() - begun < 4
