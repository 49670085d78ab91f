"""One HTTP connection: uvicorn's, with limits on the time of a request's head and of an answer, and an end in order."""

from __future__ import annotations

import asyncio
import http
import time
from typing import Any

import h11
from uvicorn.config import Config
from uvicorn.protocols.http.flow_control import CLOSE_HEADER
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from attentionvote.inference.server.network.book import ConnectionBook
from attentionvote.inference.server.network.chunks import BoundedChunks
from attentionvote.inference.server.network.transport import LingeringTransport
from attentionvote.inference.server.refusal import Refusal, bad_request

HEAD_S, ANSWER_S = 10.0, 10.0


class CellConnection(H11Protocol):
    """A connection.

    Args:
        config, server_state, app_state: uvicorn's.
        book: where the connection is entered, from its acceptance to its end.

    Attributes:
        opening: the TLS handshake while it lasts.
        silent_since: of the monotonic clock: when the last byte came.
        spare: whether it was let in beyond the limit, for questions about health.
    """

    def __init__(
        self, config: Config, server_state: ServerState, app_state: dict[str, Any], book: ConnectionBook
    ) -> None:
        super().__init__(config, server_state, app_state)
        self.app = self._answer_request
        self.conn: BoundedChunks = BoundedChunks()
        self.opening: asyncio.Task[None] | None = None
        self.silent_since = time.monotonic()
        self.spare = False
        self._book = book
        self._lingering: LingeringTransport | None = None
        self._head_timer: asyncio.TimerHandle | None = None
        self._answer_timer: asyncio.TimerHandle | None = None

    @property
    def busy(self) -> bool:
        """Whether a request is in progress."""
        return self.cycle is not None and not (self.cycle.response_complete or self.transport.is_closing())

    def give_way(self) -> None:
        """End at once."""
        if self.transport is not None:
            self.transport.abort()
        elif self.opening is not None:
            self.opening.cancel()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """The connection stands; the first request's head is awaited."""
        self._lingering = LingeringTransport(transport, self._unread)
        super().connection_made(self._lingering)
        self._await_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection is gone."""
        self._cancel_timers()
        if self._lingering is not None:
            self._lingering.lost()
        self._book.remove(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Bytes came; after the last answer they are dropped unread."""
        self.silent_since = time.monotonic()
        if self._lingering is not None and self._lingering.is_closing():
            self._lingering.drop(len(data))
            return
        super().data_received(data)
        self._await_head()

    def on_response_complete(self) -> None:
        """An answer was sent: the next request may come, or has come already."""
        self.silent_since = time.monotonic()
        super().on_response_complete()
        if self.conn.trailing_data[0]:
            self._await_head()

    def send_400_response(self, msg: str) -> None:  # noqa: ARG002 -- uvicorn's own words
        """Refuse what is no HTTP, or comes in too small chunks."""
        if self.conn.problem is not None:
            self._book.closed("chunks")
            self._refuse(bad_request(self.conn.problem))
        else:
            self._refuse(
                bad_request("the request must be HTTP/1.1 with a line and headers of at most 64 KiB, but it is not")
            )

    def shutdown(self) -> None:
        """The server ends: so does the connection, after the request in progress."""
        if self.busy:
            super().shutdown()
        elif self._lingering is not None:
            self._lingering.hurry()
            self._lingering.close()

    def pause_writing(self) -> None:
        """The client does not read its answer."""
        super().pause_writing()
        if self._answer_timer is None:
            self._answer_timer = self.loop.call_later(ANSWER_S, self._end_unread_answer)

    def resume_writing(self) -> None:
        """The client reads on."""
        super().resume_writing()
        if self._answer_timer is not None:
            self._answer_timer.cancel()
            self._answer_timer = None

    async def _answer_request(self, scope: Any, receive: Any, send: Any) -> None:
        """The application, where an answer to a body that has not come to its end is the connection's last."""
        health_only = self._book.health_only(self)
        scope["state"]["most_connections"] = self._book.most if health_only else None

        async def closing(message: Any) -> None:
            if message["type"] == "http.response.start" and (self.cycle.more_body or health_only):
                message = {**message, "headers": [*message.get("headers", ()), CLOSE_HEADER]}
            await send(message)

        await self.config.loaded_app(scope, receive, closing)

    def _unread(self) -> bool:
        """Whether the client may still be sending what nobody reads."""
        return self.conn.their_state in (h11.SEND_BODY, h11.ERROR) or bool(self.conn.trailing_data[0])

    def _await_head(self) -> None:
        """Limit the time of a request's line and headers; from its first byte on, or from the connection's start."""
        if self.busy or self.transport.is_closing():
            if self._head_timer is not None:
                self._head_timer.cancel()
                self._head_timer = None
        elif self._head_timer is None:
            self._head_timer = self.loop.call_later(HEAD_S, self._end_without_head)

    def _end_without_head(self) -> None:
        self._head_timer = None
        if self.transport.is_closing():
            return
        self._book.closed("head")
        if not self.conn.trailing_data[0]:
            self.transport.close()
            return
        sentence = f"a request's line and headers must arrive within {HEAD_S:g} s, but they did not: send them at once"
        self._refuse(Refusal(408, sentence, "rejected"))

    def _end_unread_answer(self) -> None:
        self._book.closed("answer")
        self.transport.abort()

    def _refuse(self, refusal: Refusal) -> None:
        """Answer before or instead of the application, and end."""
        if self.cycle is not None:  # the application waits for the rest of a body that does not come
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        if self.conn.our_state not in (h11.IDLE, h11.SEND_RESPONSE):  # in the middle of another answer
            self.transport.abort()
            return
        response = refusal.response()
        headers = [*response.raw_headers, CLOSE_HEADER]
        head = h11.Response(
            status_code=refusal.status, headers=headers, reason=http.HTTPStatus(refusal.status).phrase.encode()
        )
        for event in (head, h11.Data(data=bytes(response.body)), h11.EndOfMessage()):
            self.transport.write(self.conn.send(event))
        self.transport.close()

    def _cancel_timers(self) -> None:
        for timer in (self._head_timer, self._answer_timer):
            if timer is not None:
                timer.cancel()
        self._unset_keepalive_if_required()
