"""Whatever a registry drips, a question to it ends in its time; real servers on the loopback interface."""

from __future__ import annotations

import asyncio
import itertools
import re
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from attentionvote.inference.bundles.signature import load_public_key
from attentionvote.inference.errors import BundleError, RegistryError
from attentionvote.inference.fetching import registry as registry_module
from attentionvote.inference.fetching.access import Access
from attentionvote.inference.fetching.bundles import FetchedBundles
from attentionvote.inference.fetching.reference import RegistryVersion, parse_reference
from attentionvote.inference.fetching.registry import Registry
from attentionvote.inference.server.metrics import Metrics
from attentionvote.inference.server.model import following as following_module
from attentionvote.inference.server.model.bundle_loading import BundleLoader
from attentionvote.inference.server.model.following import Following
from attentionvote.inference.server.model.reloading import BundleWatch
from attentionvote.inference.server.model.serving import Serving
from attentionvote.inference.server.worker.process import WorkerSettings
from attentionvote.inference.server.worker.workers import Workers

LIMIT_S, PAUSE_S = 1.0, 0.05
HEAD = b"HTTP/1.1 200 OK\r\n"
Drip = tuple[bytes, Iterator[bytes]]


class DrippingServer:
    """Answers every request with some bytes at once, and then some every 50 ms until the other side has gone.

    Args:
        at_once: sent after the request.
        drops: sent one after the other.
        tls: wraps each connection.
    """

    def __init__(self, at_once: bytes, drops: Callable[[], Iterator[bytes]], tls: ssl.SSLContext | None = None) -> None:
        self._at_once, self._drops, self._tls = at_once, drops, tls
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self.asked = 0
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            self._threads.append(threading.Thread(target=self._answer, args=(connection,)))
            self._threads[-1].start()

    def _answer(self, connection: socket.socket) -> None:
        with connection:
            connection.settimeout(20)
            try:
                if self._tls is not None:
                    connection = self._tls.wrap_socket(connection, server_side=True)
                with connection:
                    connection.recv(65536)
                    self.asked += 1
                    connection.sendall(self._at_once)
                    for drop in self._drops():
                        connection.sendall(drop)
                        time.sleep(PAUSE_S)
            except OSError:
                return

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for thread in self._threads:
            thread.join(20)
            assert not thread.is_alive()


def bytes_of(text: bytes) -> Iterator[bytes]:
    return (bytes([byte]) for byte in text)


CASES: dict[str, tuple[bytes, Callable[[], Iterator[bytes]]]] = {
    "status line": (b"", lambda: itertools.chain(bytes_of(b"HTTP/1.1 200 "), itertools.repeat(b"O"))),
    "one header": (HEAD + b"X: ", lambda: itertools.repeat(b"x")),
    "header lines": (HEAD, lambda: (f"X-{i}: y\r\n".encode() for i in range(90))),
    "more answers to come": (b"", lambda: itertools.repeat(b"HTTP/1.1 100 Continue\r\n\r\n")),
    "body": (HEAD + b"Content-Length: 100000\r\n\r\n", lambda: itertools.repeat(b" ")),
    "body without a length": (HEAD + b"\r\n", lambda: itertools.repeat(b" ")),
    "chunks": (HEAD + b"Transfer-Encoding: chunked\r\n\r\n", lambda: itertools.repeat(b"1\r\n \r\n")),
    "chunk length": (HEAD + b"Transfer-Encoding: chunked\r\n\r\n", lambda: itertools.repeat(b"0")),
    "trailers": (HEAD + b"Transfer-Encoding: chunked\r\n\r\n1\r\n{\r\n0\r\n", lambda: itertools.repeat(b"X: y\r\n")),
    "body of a refusal": (b"HTTP/1.1 503 No\r\nContent-Length: 9999\r\n\r\n", lambda: itertools.repeat(b" ")),
    "silence": (b"", lambda: (b"" for _ in range(200))),
}


@pytest.fixture
def drip(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., DrippingServer]]:
    """Starts dripping servers; a question takes at most a second."""
    monkeypatch.setattr(registry_module, "_LONGEST_ANSWER_S", LIMIT_S)
    monkeypatch.setattr(registry_module, "_SLOWEST_BYTES_PER_S", 1e9)
    servers: list[DrippingServer] = []

    def start(*words: Any) -> DrippingServer:
        servers.append(DrippingServer(*words))
        return servers[-1]

    yield start
    for server in servers:
        server.close()


def seconds_of(work: Callable[[], Any], kind: type[Exception] = RegistryError) -> tuple[float, Exception]:
    """How long work took to be refused, and the refusal."""
    started = time.monotonic()
    with pytest.raises(kind) as caught:
        work()
    return time.monotonic() - started, caught.value


@pytest.mark.parametrize("case", CASES)
def test_a_question_ends_in_its_time(drip: Callable[..., DrippingServer], case: str) -> None:
    server = drip(*CASES[case])
    registry = Registry(Access(f"http://127.0.0.1:{server.port}"))
    seconds, error = seconds_of(lambda: registry.resolve(parse_reference("models:/gear@champion")))
    assert LIMIT_S * 0.9 < seconds < LIMIT_S + 1.5
    assert isinstance(error, RegistryError)
    assert error.away
    assert server.asked == 1
    assert re.search(
        r"cannot be reached: (the answer takes too long|timed out)|cannot answer now \(status 503\)", str(error)
    )


@pytest.mark.parametrize("case", ["body", "chunks", "header lines"])
def test_a_file_ends_in_its_time(drip: Callable[..., DrippingServer], case: str) -> None:
    server = drip(*CASES[case])
    registry = Registry(Access(f"http://127.0.0.1:{server.port}"))
    version = RegistryVersion("gear", "1", "0" * 64)
    seconds, _ = seconds_of(lambda: list(registry.pieces(version, "model.onnx", 10**6)))
    assert LIMIT_S * 0.9 < seconds < LIMIT_S + 1.5


def test_redirects_belong_to_the_same_exchange(drip: Callable[..., DrippingServer]) -> None:
    """Each of them would otherwise have a time of its own."""
    location = HEAD.replace(b"200 OK", b"302 Found") + b"Location: /again\r\n"
    server = drip(location, lambda: itertools.chain((f"X-{i}: y\r\n".encode() for i in range(10)), [b"\r\n"]))
    registry = Registry(Access(f"http://127.0.0.1:{server.port}"))
    seconds, _ = seconds_of(lambda: registry.resolve(parse_reference("models:/gear@champion")))
    assert seconds < LIMIT_S + 1.5
    assert server.asked > 1


def test_a_handshake_and_an_answer_over_tls_end_in_their_time(
    drip: Callable[..., DrippingServer], certificate: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cert, key = certificate(tmp_path)
    monkeypatch.setenv("SSL_CERT_FILE", str(cert))
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    tls.load_cert_chain(cert, key)
    handshake = drip(b"", lambda: bytes_of(b"\x16\x03\x03\x40\x00" + b"\x02" * 400))
    answer = drip(*CASES["one header"], tls)
    for server in (handshake, answer):
        registry = Registry(Access(f"https://127.0.0.1:{server.port}"))
        seconds, error = seconds_of(
            lambda registry=registry: registry.resolve(parse_reference("models:/gear@champion"))
        )
        assert LIMIT_S * 0.9 < seconds < LIMIT_S + 1.5, error
        assert server.asked == 1


def test_closing_ends_a_dripping_answer_at_its_next_bytes(drip: Callable[..., DrippingServer]) -> None:
    server = drip(*CASES["one header"])
    registry = Registry(Access(f"http://127.0.0.1:{server.port}"))
    threading.Timer(0.2, registry.close).start()
    seconds, _ = seconds_of(lambda: registry.resolve(parse_reference("models:/gear@champion")))
    assert seconds < LIMIT_S * 0.9


def test_a_quick_answer_is_read_whole(drip: Callable[..., DrippingServer]) -> None:
    server = drip(HEAD + b"Content-Length: 7\r\n\r\n0123456", lambda: iter(()))
    registry = Registry(Access(f"http://127.0.0.1:{server.port}"))
    version = RegistryVersion("gear", "1", "0" * 64)
    assert b"".join(registry.pieces(version, "model.onnx", 7)) == b"0123456"
    with pytest.raises(BundleError, match="must have at most 6 bytes, got more"):
        list(registry.pieces(version, "model.onnx", 6))


def test_a_dripping_registry_is_a_failing_one_for_the_metrics(
    drip: Callable[..., DrippingServer], trusted_key: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before its time is over, and after."""
    server = drip(*CASES["trailers"])
    registry = Registry(Access(f"http://127.0.0.1:{server.port}"))
    key = load_public_key(trusted_key)

    monkeypatch.setattr(following_module, "_SLOW_S", 0.3)

    async def ask() -> tuple[str | None, str, str]:
        metrics = Metrics()
        serving = Serving(metrics)
        bundles = FetchedBundles(tmp_path / "registry", parse_reference("models:/gear@champion"), key)
        loader = BundleLoader(key, lambda bundle, _: Workers(bundle, WorkerSettings()), None)
        watch = BundleWatch(bundles.link, loader, serving, metrics)
        following = Following(registry, bundles, watch, serving, metrics)
        check = asyncio.ensure_future(following.check())
        await asyncio.sleep(0.6)
        meanwhile = metrics.text().decode()
        problem = await check
        following.close()
        serving.close()
        return problem, meanwhile, metrics.text().decode()

    problem, meanwhile, after = asyncio.run(asyncio.wait_for(ask(), 10))
    assert problem is not None
    assert "cannot be reached" in problem
    assert "attentionvote_registry_failing 1.0" in meanwhile
    assert "models:/gear@champion has been asked for or fetched for 0.3 s, and it is not over" in meanwhile
    assert "attentionvote_registry_failing 1.0" in after
