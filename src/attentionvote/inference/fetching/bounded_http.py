"""HTTP whose whole exchange ends in time: connection, handshake, headers, body and trailers together.

A socket's own timeout is for the next bytes only, so a server that sends one byte now and then holds a reader for ever.
Here every wait is bounded by what is left of the exchange, and another thread may end it.
"""

from __future__ import annotations

import http.client
import io
import socket
import ssl
import threading
import time
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Exchange:
    """When a question and its answer must be over.

    Attributes:
        end: on the monotonic clock.
        longest_wait_s: for a connection and for the next bytes.
        closed: ends it at its next bytes, from any thread.
    """

    end: float
    longest_wait_s: float
    closed: threading.Event

    def wait_s(self) -> float:
        """How long the next step may take.

        Raises:
            TimeoutError: when there is no time left.
        """
        left_s = self.end - time.monotonic()
        if left_s <= 0 or self.closed.is_set():
            raise TimeoutError("the answer takes too long")
        return min(left_s, self.longest_wait_s)


def handlers(exchange: Exchange, tls: ssl.SSLContext) -> tuple[urllib.request.BaseHandler, ...]:
    """What a urllib opener needs so that everything it asks belongs to one exchange, redirects included."""

    class Http(urllib.request.HTTPHandler):
        def http_open(self, req: urllib.request.Request) -> http.client.HTTPResponse:
            return self.do_open(_connections(http.client.HTTPConnection, exchange), req)

    class Https(urllib.request.HTTPSHandler):
        def https_open(self, req: urllib.request.Request) -> http.client.HTTPResponse:
            return self.do_open(_connections(http.client.HTTPSConnection, exchange), req, context=tls)

    return Http(), Https(context=tls)


def _connections(kind: type[http.client.HTTPConnection], exchange: Exchange) -> Callable[..., Any]:
    """Makes connections of a kind, whose answers are read within the exchange."""

    def make(host: str, **options: Any) -> http.client.HTTPConnection:
        connection = kind(host, **(options | {"timeout": exchange.wait_s()}))
        # http.client's own place for another way to connect.
        connection._create_connection = lambda address, *_: _connected(address, exchange)  # type: ignore[attr-defined]
        connection.response_class = lambda sock, **how: _Response(sock, exchange, **how)  # type: ignore[assignment]
        return connection

    return make


def _connected(address: tuple[str, int], exchange: Exchange) -> socket.socket:
    """A connection to the first address of a host that takes one. The resolver's time is its own to bound."""
    failure: OSError = OSError(f"{address[0]} has no address")
    for family, kind, protocol, _, where in socket.getaddrinfo(*address, type=socket.SOCK_STREAM):
        connection = socket.socket(family, kind, protocol)
        try:
            connection.settimeout(exchange.wait_s())
            connection.connect(where)
        except OSError as error:
            connection.close()
            failure = error
        else:
            return connection
    raise failure


class _Response(http.client.HTTPResponse):
    """An answer whose every read is bounded."""

    def __init__(self, sock: socket.socket, exchange: Exchange, **how: Any) -> None:
        super().__init__(sock, **how)
        raw = self.fp.detach()
        self.fp = io.BufferedReader(_Bounded(raw, sock, exchange))


class _Bounded(io.RawIOBase):
    """A socket's bytes, each wait for them within the exchange."""

    def __init__(self, raw: io.RawIOBase, sock: socket.socket, exchange: Exchange) -> None:
        self._raw, self._sock, self._exchange = raw, sock, exchange

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int | None:
        self._sock.settimeout(self._exchange.wait_s())
        return self._raw.readinto(buffer)

    def close(self) -> None:
        self._raw.close()
        super().close()
