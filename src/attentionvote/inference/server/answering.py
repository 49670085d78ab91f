"""One request for poses, from its first byte to the estimator's answer: admitted, received, queued, run, in time."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from starlette.requests import ClientDisconnect, Request

from attentionvote.inference.answer import Abstention, Estimate
from attentionvote.inference.errors import InputError
from attentionvote.inference.server.admission import (
    Deadline,
    Gate,
    Place,
    deadline_from_header,
    deadline_of,
    read_body,
)
from attentionvote.inference.server.metrics import Metrics
from attentionvote.inference.server.model.serving import Served, Serving
from attentionvote.inference.server.refusal import bad_request

# The estimator stops itself at the deadline; this long its own answer about that is waited for.
_GRACE_S = 0.05


class Question(NamedTuple):
    """What a body asks.

    Attributes:
        arguments: of ``PoseEstimator.estimate``.
        deadline_ms: given in the body; None without.
        request: the parsed request, for the answer's form.
    """

    arguments: Mapping[str, Any]
    deadline_ms: float | None = None
    request: Any = None


class Reply(NamedTuple):
    """An answer, the model that gave it, and what was asked."""

    answer: Estimate | Abstention
    served: Served
    question: Question


@dataclass
class Record:
    """What the log line of a request will say beside its path and status; filled on the way."""

    points: int | None = None
    detections: int | None = None
    reason: str | None = None
    outcome: str | None = None
    error: str | None = None
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Limits:
    """What a client may ask for.

    Attributes:
        deadline_ms: when the client names none.
        most_body_bytes: of a request.
    """

    deadline_ms: float
    most_body_bytes: int


class Answering:
    """Answers requests for poses.

    Args:
        serving: the model.
        gate: who may wait.
        limits: what may be asked.
        metrics: counts by stage and outcome.
    """

    def __init__(self, serving: Serving, gate: Gate, limits: Limits, metrics: Metrics) -> None:
        self.serving, self.gate, self.limits, self.metrics = serving, gate, limits, metrics

    async def ask(
        self,
        request: Request,
        read: Callable[[bytes], Question],
        name: str | None = None,
        version: str | None = None,
    ) -> Reply:
        """Answer one request.

        Args:
            request: its body not yet read.
            read: makes the question of the body, in the estimator's thread; raises InputError.
            name, version: of the model asked for; None: whatever serves.

        Raises:
            Refusal: with the status and sentence to be sent.
            ClientDisconnect: nobody waits for the answer any more.
        """
        record: Record = request.state.record
        deadline = deadline_from_header(request, self.limits.deadline_ms)
        self.serving.model(name, version)  # before a body is received for a model that is not there
        place = self.gate.enter()
        try:
            body = await read_body(request, self.limits.most_body_bytes, deadline)
            self._took(record, "receive", deadline.elapsed_s())
            served = self.serving.model(name, version)
            job = _Job(served, read, body, deadline, record)
            future = self.serving.submit(job.run)
        except BaseException:
            place.leave()
            raise
        _leave_when_done(place, future)
        answer = await self._wait(request, future, deadline)
        for stage in ("queue", "parse", "estimate"):
            self._took(record, stage, record.seconds[stage])
        self.gate.took(record.seconds["parse"] + record.seconds["estimate"])
        assert job.question is not None
        return self._judge(Reply(answer, served, job.question), record)

    async def _wait(self, request: Request, future: Future[Any], deadline: Deadline) -> Estimate | Abstention:
        """The answer, unless the deadline passes or the client leaves first: then nobody waits for it any more."""
        answer: asyncio.Future[Any] = asyncio.wrap_future(future)
        gone: asyncio.Future[Any] = asyncio.ensure_future(_disconnected(request))
        try:
            while True:
                left = deadline.remaining_s() + _GRACE_S
                done, _ = await asyncio.wait({answer, gone}, timeout=left, return_when=asyncio.FIRST_COMPLETED)
                if answer in done:
                    result: Estimate | Abstention = answer.result()
                    return result
                if gone in done:
                    raise ClientDisconnect
                if deadline.remaining_s() <= 0:  # else the body has just named a longer one
                    raise deadline.exceeded("the request waited or was worked on")
        except InputError as error:
            raise bad_request(str(error)) from error
        finally:
            gone.cancel()
            answer.cancel()  # takes it out of the queue; what runs already ends by its deadline

    def _judge(self, reply: Reply, record: Record) -> Reply:
        """Count an answer; one that came too late is an error for the client."""
        answer = reply.answer
        record.points = answer.points_given
        record.detections = len(answer.detections) if isinstance(answer, Estimate) else 0
        if isinstance(answer, Abstention):
            record.reason = answer.reason
            if answer.reason == "deadline_exceeded":
                refusal = bad_request(answer.message, 504)
                refusal.outcome, refusal.content = "deadline", answer.to_dict()
                raise refusal
        self.metrics.detections.observe(record.detections)
        record.outcome = "ok" if isinstance(answer, Estimate) else "abstained"
        return reply

    def _took(self, record: Record, stage: str, seconds: float) -> None:
        record.seconds[stage] = seconds
        self.metrics.seconds.labels(stage).observe(seconds)


class _Job:
    """The part of a request that runs in the estimator's thread."""

    def __init__(
        self, served: Served, read: Callable[[bytes], Question], body: bytes, deadline: Deadline, record: Record
    ) -> None:
        self.question: Question | None = None
        self._served, self._read, self._body = served, read, body
        self._deadline, self._record = deadline, record
        self._queued = time.monotonic()

    def run(self) -> Estimate | Abstention:
        """Parse and estimate; Refusal and InputError reach the client."""
        begun = time.monotonic()
        seconds = self._record.seconds
        seconds["queue"] = begun - self._queued
        if self._deadline.remaining_s() <= 0:
            raise self._deadline.exceeded("the request waited in the queue")
        question = self.question = self._read(self._body)
        self._body = b""
        if question.deadline_ms is not None:
            given = deadline_of("parameter deadline_ms", question.deadline_ms, self._deadline.start)
            self._deadline.budget_s = given.budget_s
        parsed = time.monotonic()
        seconds["parse"] = parsed - begun
        left = max(self._deadline.remaining_s(), 0.0)
        answer = self._served.estimator.estimate(**question.arguments, deadline_s=left)
        seconds["estimate"] = time.monotonic() - parsed
        return answer


async def _disconnected(request: Request) -> None:
    """Return when the client is gone."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


def _leave_when_done(place: Place, future: Future[Any]) -> None:
    """Free a place when the work has ended, in whichever thread that is."""
    loop = asyncio.get_running_loop()

    def leave(_: Future[Any]) -> None:
        with suppress(RuntimeError):  # the loop has ended: the server is gone
            loop.call_soon_threadsafe(place.leave)

    future.add_done_callback(leave)
