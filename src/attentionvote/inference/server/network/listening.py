"""The server's ear: takes connections up, gives each its place in the book, and ends in order on a signal."""

from __future__ import annotations

import asyncio
import errno
import logging
import signal
import socket
from contextlib import suppress

import uvicorn

from attentionvote.inference.server.json_logs import say
from attentionvote.inference.server.network.book import ConnectionBook
from attentionvote.inference.server.network.connection import CellConnection

HANDSHAKE_S, FAREWELL_S = 10.0, 2.0
_ENDING_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
_NO_HANDLE = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
_TRY_AGAIN_S = 0.1


class CellServer(uvicorn.Server):
    """uvicorn's server, with a listener of its own: asyncio's would log thousands of lines without a file handle.

    Args:
        config: uvicorn's.
        listener: bound and listening.
        book: of the connections.
    """

    def __init__(self, config: uvicorn.Config, listener: socket.socket, book: ConnectionBook) -> None:
        super().__init__(config)
        self._listener, self._book = listener, book
        self._accepting: asyncio.Task[None] | None = None

    def end_on_signals(self) -> None:
        """Let SIGTERM, Ctrl-C and SIGHUP end the server in order from now on, before it runs as well.

        uvicorn takes the first two over while it runs, and raises them once more when it is done.
        """
        for number in _ENDING_SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:  # nohup
                signal.signal(number, self._end)

    def _end(self, *_: object) -> None:
        self.should_exit = True

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start the application and listen."""
        del sockets
        await super().startup(sockets=[])
        self._accepting = asyncio.create_task(self._accept())
        self._accepting.add_done_callback(self._accepting_ended)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Take no more connections, let requests end, and the application."""
        del sockets
        if self._accepting is not None:
            self._accepting.cancel()
            with suppress(asyncio.CancelledError):
                await self._accepting
        self._listener.close()
        for entry in list(self._book.entries):
            if entry.transport is None:
                entry.give_way()
        await super().shutdown(sockets=[])

    async def _accept(self) -> None:
        loop = asyncio.get_running_loop()
        self._listener.setblocking(False)
        while True:
            await asyncio.sleep(0)  # accepting does not wait while there is a connection: others get their turn
            try:
                accepted, _ = await loop.sock_accept(self._listener)
            except OSError as error:
                if error.errno in _NO_HANDLE:
                    self._book.say_once(
                        "handles", f"no connection can be taken up ({error.strerror}); it is tried again"
                    )
                    self._book.make_room()
                    await asyncio.sleep(_TRY_AGAIN_S)
                continue
            connection = CellConnection(self.config, self.server_state, self.lifespan.state, self._book)
            if self._book.admit(connection):
                connection.opening = loop.create_task(self._open(connection, accepted))
            else:
                accepted.close()

    async def _open(self, connection: CellConnection, accepted: socket.socket) -> None:
        """Make a connection of a socket: the TLS handshake, where there is one."""
        tls = self.config.ssl
        times = {} if tls is None else {"ssl_handshake_timeout": HANDSHAKE_S, "ssl_shutdown_timeout": FAREWELL_S}
        try:
            await asyncio.get_running_loop().connect_accepted_socket(lambda: connection, accepted, ssl=tls, **times)
        except OSError:  # no handshake, not in time, or the client has left
            self._book.closed("handshake")
            self._book.remove(connection)
        except asyncio.CancelledError:
            self._book.remove(connection)
            raise
        finally:
            connection.opening = None
            if connection.transport is None:
                accepted.close()

    def _accepting_ended(self, task: asyncio.Task[None]) -> None:
        """Accepting never ends by itself; if it does, so does the server, which its supervisor starts again."""
        if not task.cancelled():
            say("error", f"no more connections are taken up: {task.exception()!r}", logging.CRITICAL)
            self.should_exit = True
