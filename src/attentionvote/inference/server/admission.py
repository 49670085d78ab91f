"""Admission of requests: a bounded number of requests, each with a deadline that starts when its first byte arrives.

A request takes its place when its body is there (``reception``), so that nobody holds one who only drips. The place is
free again when the work has ended, not when the answer was sent: an answer may be early (the deadline), the worker is
busy all the same.
"""

from __future__ import annotations

import math

from starlette.requests import Request

from attentionvote.inference.errors import InputError
from attentionvote.inference.server.deadline import Deadline, deadline_seconds, late_answer
from attentionvote.inference.server.metrics import Metrics
from attentionvote.inference.server.refusal import Refusal

_SHORTEST_S = 0.02
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


class Admission:
    """A request's place among those that run or wait; :meth:`leave` may be called more than once."""

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

    def check(self) -> None:
        """Refuse when there is no place, before a body is sent in vain.

        Raises:
            Refusal: 503 with ``Retry-After``.
        """
        if self._inside >= self._most:
            raise Refusal(
                503,
                f"at most {self._most} requests may run or wait, and all places are taken: try again shortly",
                "overloaded",
                # Whole seconds are the standard's; whoever knows the other header is back sooner.
                {"Retry-After": str(max(1, math.ceil(self._typical_s))), RETRY_HEADER: f"{self._typical_s * 1e3:.0f}"},
            )

    def enter(self) -> Admission:
        """Take a place.

        Raises:
            Refusal: 503 with ``Retry-After`` when there is none.
        """
        self.check()
        self._inside += 1
        self._metrics.waiting.set(self._inside)
        return Admission(self)

    def release(self) -> None:
        """A place is free again; called by :class:`Admission`."""
        self._inside -= 1
        self._metrics.waiting.set(self._inside)

    def took(self, seconds: float) -> None:
        """Learn how long an estimate takes, for ``Retry-After``."""
        self._typical_s += 0.2 * (max(seconds, _SHORTEST_S) - self._typical_s)
