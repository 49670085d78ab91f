"""An HTTP connection whose time limit is of the whole exchange: a socket's own begins anew with every byte."""

from __future__ import annotations

import http.client
import io
import socket
import ssl
import time
from typing import Any


class TimedConnection(http.client.HTTPConnection):
    """A connection to a server.

    Args:
        host, port: of the server; port None: the scheme's.
        tls: how to trust it; None: no TLS.

    Attributes:
        until: of the monotonic clock: when everything must have ended. Set it before every exchange.
    """

    def __init__(self, host: str, port: int | None, tls: ssl.SSLContext | None) -> None:
        self.default_port = http.client.HTTP_PORT if tls is None else http.client.HTTPS_PORT
        super().__init__(host, port)
        self.until = 0.0
        self._tls = tls

    def left_s(self) -> float:
        """Seconds until the end.

        Raises:
            TimeoutError: when there are none.
        """
        left = self.until - time.monotonic()
        if left <= 0:
            raise TimeoutError("the time for this exchange has passed")
        return left

    def connect(self) -> None:
        """Connect to the first of the host's addresses that answers (a name's look-up has the system's own limit)."""
        problem: OSError | None = None
        for family, kind, protocol, _, address in socket.getaddrinfo(self.host, self.port, type=socket.SOCK_STREAM):
            plain = socket.socket(family, kind, protocol)
            try:
                plain.settimeout(self.left_s())
                plain.connect(address)
                plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                if self._tls is not None:
                    plain.settimeout(self.left_s())
                    plain = self._tls.wrap_socket(plain, server_hostname=self.host)
            except OSError as error:
                plain.close()
                problem = error
                continue
            self.sock = _TimedSocket(plain, self)
            return
        raise problem or OSError("the host has no address")


class _TimedSocket:
    """What http.client asks of a socket, within its connection's time."""

    def __init__(self, plain: socket.socket, connection: TimedConnection) -> None:
        self._plain, self._connection = plain, connection

    def sendall(self, data: Any) -> None:
        rest = memoryview(data)
        while len(rest):
            self._plain.settimeout(self._connection.left_s())
            rest = rest[self._plain.send(rest) :]

    def makefile(self, _mode: str) -> io.BufferedReader:
        return io.BufferedReader(_TimedReader(self._plain, self._connection))

    def close(self) -> None:
        self._plain.close()


class _TimedReader(io.RawIOBase):
    def __init__(self, plain: socket.socket, connection: TimedConnection) -> None:
        super().__init__()
        self._plain, self._connection = plain, connection
        # Holds the socket open until the answer was read, also when the connection is closed before.
        self._file = plain.makefile("rb", buffering=0)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int | None:
        self._plain.settimeout(self._connection.left_s())
        return self._file.readinto(buffer)

    def close(self) -> None:
        self._file.close()
        super().close()
