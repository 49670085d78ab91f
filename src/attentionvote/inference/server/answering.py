"""One request for poses, from its first byte to the worker's answer: received, admitted, queued, run, in time."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response

from attentionvote.inference.server.admission import Admission, Gate, deadline_from_header, too_late
from attentionvote.inference.server.deadline import Deadline
from attentionvote.inference.server.metrics import Metrics
from attentionvote.inference.server.model.serving import Served, Serving
from attentionvote.inference.server.reception import Reception
from attentionvote.inference.server.refusal import Refusal
from attentionvote.inference.server.tally import Tally
from attentionvote.inference.server.worker.channel import Message, SharedContent
from attentionvote.inference.server.worker.process import WorkerLost

# A job stops itself at its deadline; this long its own answer about that is waited for.
_GRACE_S = 0.05


@dataclass
class Record:
    """What the log line of a request will say beside its path and status; filled on the way."""

    points: int | None = None
    detections: int | None = None
    withheld: int | None = None
    reason: str | None = None
    outcome: str | None = None
    error: str | None = None
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Limits:
    """What a client may ask for.

    Attributes:
        deadline_ms: when the client names none.
        most_deadline_ms: that a client may name.
        most_body_bytes: of a request.
    """

    deadline_ms: float
    most_deadline_ms: float
    most_body_bytes: int


class WorkerFailed(RuntimeError):
    """A defect: the worker met an error that nobody foresaw. The text is its traceback."""


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
        self.reception = Reception(limits.most_body_bytes)
        self.tally = Tally()

    async def ask(
        self, request: Request, job: Mapping[str, Any], name: str | None = None, version: str | None = None
    ) -> Response:
        """Answer one request.

        Args:
            request: its body not yet read.
            job: what a worker does with the body, see ``worker.jobs``.
            name, version: of the model asked for; None: whatever serves.

        Raises:
            Refusal: with the status and sentence to be sent.
            ClientDisconnect: nobody waits for the answer any more.
        """
        record: Record = request.state.record
        limits = self.limits
        deadline = deadline_from_header(request, limits.deadline_ms, limits.most_deadline_ms)
        self.serving.model(name, version)  # before a body is received for a model that is not there
        self.gate.check()
        content = await self.reception.body(request, deadline)
        try:
            admission = self.gate.enter()
        except BaseException:
            content.close()
            raise
        try:
            self._took(record, "receive", deadline.elapsed_s())
            served = self.serving.model(name, version)
            served.workers.hold()
            asked = {**job, "most_deadline_ms": limits.most_deadline_ms}
            future = self.serving.submit(_worked, served, asked, content, deadline, record, time.monotonic())
        except BaseException:
            admission.leave()
            content.close()
            raise
        _leave_when_done(admission, content, served, future)
        answer = await self._wait(request, future, deadline)
        for stage in ("queue", "parse", "estimate"):
            if stage in record.seconds:
                self._took(record, stage, record.seconds[stage])
        self.tally.add(served.version, record.seconds, answered=answer.head["status"] == 200)
        if answer.head["status"] == 200:
            self.gate.took(sum(record.seconds.get(stage, 0.0) for stage in ("parse", "estimate")))
        return self._response(answer, record)

    async def _wait(self, request: Request, future: Future[Message], deadline: Deadline) -> Message:
        """The answer, unless the deadline passes or the client leaves first: then nobody waits for it any more."""
        answer: asyncio.Future[Message] = asyncio.wrap_future(future)
        gone: asyncio.Future[Any] = asyncio.ensure_future(_disconnected(request))
        try:
            while True:
                left = deadline.remaining_s() + _GRACE_S
                done, _ = await asyncio.wait({answer, gone}, timeout=left, return_when=asyncio.FIRST_COMPLETED)
                if answer in done:
                    return answer.result()
                if gone in done:
                    raise ClientDisconnect
                if deadline.remaining_s() <= 0:  # else the body has just named a longer one
                    raise too_late(deadline, "the request waited or was worked on")
        finally:
            gone.cancel()
            answer.cancel()  # takes it out of the queue; what runs already ends by its deadline, or is ended

    def _response(self, answer: Message, record: Record) -> Response:
        """The answer as it is sent; what a worker refused is refused."""
        head = answer.head
        record.outcome, record.error = head["outcome"], head.get("error")
        record.reason, record.points, record.detections = head.get("reason"), head.get("points"), head.get("detections")
        record.withheld = head.get("withheld") or None
        if head["status"] != 200:
            if "trace" in head:
                raise WorkerFailed(head["trace"])
            raise Refusal(head["status"], head["error"], head["outcome"], content=head.get("abstention"))
        if record.detections is not None:
            self.metrics.detections.observe(record.detections)
        self.metrics.withheld.inc(record.withheld or 0)
        return Response(bytes(answer.content), headers=head["headers"])

    def _took(self, record: Record, stage: str, seconds: float) -> None:
        record.seconds[stage] = seconds
        self.metrics.seconds.labels(stage).observe(seconds)


def _worked(
    served: Served, job: dict[str, Any], content: SharedContent, deadline: Deadline, record: Record, queued: float
) -> Message:
    """Let a worker do it, in a thread that waits for it; a Refusal reaches the client."""
    if deadline.remaining_s() <= 0:
        raise too_late(deadline, "the request waited in the queue")
    try:
        answer = served.workers.ask(job, content, deadline)
    except WorkerLost as loss:
        raise _lost(loss, deadline) from None
    if answer is None:
        raise too_late(deadline, "a lost worker was replaced")
    seconds: dict[str, float] = answer.head["seconds"]
    record.seconds["queue"] = time.monotonic() - queued - sum(seconds.values())
    record.seconds |= seconds
    return answer


def _lost(loss: WorkerLost, deadline: Deadline) -> Refusal:
    """What the client is told whose request took its worker with it."""
    if loss.reason == "deadline":
        return too_late(deadline, "the request was worked on, and its worker was ended")
    if loss.reason == "memory":
        sentence = (
            "the body must be readable within this server's memory, but its worker was ended for taking more: "
            "crop or thin the cloud out"
        )
        return Refusal(422, sentence, "rejected")
    return Refusal(500, "the worker ended while it worked on this request: the server's log says how", "failed")


async def _disconnected(request: Request) -> None:
    """Return when the client is gone."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


def _leave_when_done(admission: Admission, content: SharedContent, served: Served, future: Future[Message]) -> None:
    """Free place, body and workers when the work has ended, in whichever thread that is."""
    loop = asyncio.get_running_loop()

    def leave(_: Future[Message]) -> None:
        content.close()
        served.workers.release()
        with suppress(RuntimeError):  # the loop has ended: the server is gone
            loop.call_soon_threadsafe(admission.leave)

    future.add_done_callback(leave)
