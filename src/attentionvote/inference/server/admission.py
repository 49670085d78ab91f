"""Who may wait: a bounded number of requests, each with a deadline that starts when its first byte arrives.

A request is admitted before its body is read, so the memory of bodies is bounded together with the queue. Its place
is free again when its work has ended, not when its answer was sent: an answer may be early (the deadline), the
estimator is busy all the same.
"""

from __future__ import annotations

import asyncio
import math

from starlette.requests import Request

from attentionvote.inference.errors import InputError
from attentionvote.inference.server.deadline import Deadline, deadline_seconds, late_answer
from attentionvote.inference.server.metrics import Metrics
from attentionvote.inference.server.refusal import Refusal, bad_request
from attentionvote.inference.server.worker.channel import SharedContent

DEADLINE_HEADER, RETRY_HEADER = "X-Deadline-Ms", "X-Retry-After-Ms"


def deadline_from_header(request: Request, default_ms: float, most_ms: float) -> Deadline:
    """The deadline of ``X-Deadline-Ms``, or the server's own.

    Raises:
        InputError: when the header is no number in range.
    """
    text = request.headers.get(DEADLINE_HEADER)
    if text is None:
        return Deadline(default_ms / 1e3)
    try:
        if not (text.isascii() and len(text) <= 20 and "_" not in text):
            raise ValueError
        number = float(text)
    except ValueError:
        raise InputError(f"{DEADLINE_HEADER} must be a number of milliseconds, got {text[:40]!r}") from None
    return Deadline(deadline_seconds(DEADLINE_HEADER, number, most_ms))


def too_late(deadline: Deadline, doing: str) -> Refusal:
    """The answer when a deadline has passed while something was done."""
    sentence = deadline.sentence(doing)
    return Refusal(504, sentence, "deadline", content=late_answer(sentence))


class Place:
    """A request's place; :meth:`leave` may be called more than once."""

    def __init__(self, gate: Gate) -> None:
        self._gate: Gate | None = gate

    def leave(self) -> None:
        """Give the place to the next request."""
        if self._gate is not None:
            gate, self._gate = self._gate, None
            gate.release()


class Gate:
    """Admits one running request and a few that wait. Lives on the event loop.

    Args:
        queue: how many may wait beside the one that runs.
        metrics: shows how many are in.
    """

    def __init__(self, queue: int, metrics: Metrics) -> None:
        self._most = 1 + queue
        self._inside = 0
        self._metrics = metrics
        self._typical_s = 0.2

    def enter(self) -> Place:
        """Take a place.

        Raises:
            Refusal: 503 with ``Retry-After`` when there is none.
        """
        if self._inside >= self._most:
            raise Refusal(
                503,
                f"at most {self._most} requests may run or wait, and all places are taken: try again shortly",
                "overloaded",
                # Whole seconds are the standard's; whoever knows the other header is back sooner.
                {"Retry-After": str(max(1, math.ceil(self._typical_s))), RETRY_HEADER: f"{self._typical_s * 1e3:.0f}"},
            )
        self._inside += 1
        self._metrics.waiting.set(self._inside)
        return Place(self)

    def release(self) -> None:
        """A place is free again; called by :class:`Place`."""
        self._inside -= 1
        self._metrics.waiting.set(self._inside)

    def took(self, seconds: float) -> None:
        """Learn how long an estimate takes, for ``Retry-After``."""
        self._typical_s += 0.2 * (seconds - self._typical_s)


async def read_body(request: Request, most_bytes: int, deadline: Deadline) -> SharedContent:
    """The body in shared memory, refused as soon as it is known to be too large. Whoever gets it closes it.

    Raises:
        Refusal: 413 beyond ``most_bytes``, 415 for a content encoding, 504 when the deadline passes first.
        starlette.requests.ClientDisconnect: the client is gone.
    """
    encoding = request.headers.get("content-encoding", "identity")
    if encoding != "identity":
        raise bad_request(f"the body must be sent without compression, got Content-Encoding {encoding[:40]!r}", 415)
    declared = request.headers.get("content-length", "")
    if declared.isdecimal() and int(declared[:20]) > most_bytes:
        raise _too_large(most_bytes, f"{declared[:20]}")
    content = SharedContent()
    try:
        async with asyncio.timeout(max(deadline.remaining_s(), 0.0)):
            async for chunk in request.stream():
                if content.size + len(chunk) > most_bytes:
                    raise _too_large(most_bytes, "more")
                content.write(chunk)
    except TimeoutError:
        content.close()
        raise too_late(deadline, "the body was received") from None
    except BaseException:
        content.close()
        raise
    return content


def _too_large(most_bytes: int, got: str) -> Refusal:
    return bad_request(
        f"the body must have at most {most_bytes} bytes, got {got}: crop the cloud, or start the server with a larger "
        "--max-body-mb",
        413,
    )
