"""Bodies on their way in: bounded one by one and all together; whoever takes longest gives way to the others."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

from starlette.requests import Request

from attentionvote.inference.server.admission import too_late
from attentionvote.inference.server.deadline import Deadline
from attentionvote.inference.server.refusal import Refusal, bad_request
from attentionvote.inference.server.worker.channel import SharedContent

MOST_AT_ONCE = 32
_MOST_LARGE = 4


@dataclass(eq=False)
class _Incoming:
    """A body that is being received."""

    content: SharedContent
    limit: asyncio.Timeout
    gives_way: bool = False


class Reception:
    """Receives bodies. Lives on the event loop.

    At most 32 are received at once, and no more bytes of them than four bodies may have: beyond either, the one that
    has been coming longest is refused. An honest client's body is there in milliseconds; one that drips is soon oldest.

    Args:
        most_bytes: of a body.
    """

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes = most_bytes
        self._incoming: list[_Incoming] = []  # in the order of their arrival

    async def body(self, request: Request, deadline: Deadline) -> SharedContent:
        """The body in shared memory, refused as soon as it is known to be too large. Whoever gets it closes it.

        Raises:
            Refusal: 413 beyond ``most_bytes``, 415 for a content encoding, 504 when the deadline passes first, 503 when
                others come and this one takes longest.
            starlette.requests.ClientDisconnect: the client is gone.
        """
        encoding = request.headers.get("content-encoding", "identity")
        if encoding != "identity":
            raise bad_request(f"the body must be sent without compression, got Content-Encoding {encoding[:40]!r}", 415)
        declared = request.headers.get("content-length", "")
        if declared.isdecimal() and int(declared[:20]) > self._most_bytes:
            raise self._too_large(f"{declared[:20]}")
        content = SharedContent()
        incoming: _Incoming | None = None
        try:
            async with asyncio.timeout(max(deadline.remaining_s(), 0.0)) as limit:
                incoming = _Incoming(content, limit)
                self._incoming.append(incoming)
                self._make_room()
                async for chunk in request.stream():
                    if content.size + len(chunk) > self._most_bytes:
                        raise self._too_large("more")
                    content.write(chunk)
                    self._make_room()
        except TimeoutError:
            content.close()
            if incoming is not None and incoming.gives_way:
                raise Refusal(
                    503,
                    "the body must come as fast as others do, but many are on their way and this one takes longest: "
                    "try again",
                    "overloaded",
                    {"Retry-After": "1"},
                ) from None
            raise too_late(deadline, "the body was received") from None
        except BaseException:
            content.close()
            raise
        finally:
            if incoming is not None:
                self._incoming.remove(incoming)
        return content

    def _make_room(self) -> None:
        """Let the oldest give way while there are too many, or too much of them."""
        staying = [incoming for incoming in self._incoming if not incoming.gives_way]
        size = sum(incoming.content.size for incoming in staying)
        while len(staying) > MOST_AT_ONCE or size > _MOST_LARGE * self._most_bytes:
            oldest = staying.pop(0)
            size -= oldest.content.size
            oldest.gives_way = True
            if not oldest.limit.expired():
                oldest.limit.reschedule(0.0)

    def _too_large(self, got: str) -> Refusal:
        return bad_request(
            f"the body must have at most {self._most_bytes} bytes, got {got}: crop the cloud, or start the server with "
            "a larger --max-body-mb",
            413,
        )
