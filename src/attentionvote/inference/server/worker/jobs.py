"""The jobs of a worker: it reads a request's body, estimates, and writes the answer's body. One at a time."""

from __future__ import annotations

import gc
import json
import time
import traceback
from collections.abc import Callable, Mapping
from typing import Any

from attentionvote.inference.answer import Abstention, Estimate
from attentionvote.inference.cell import Cell
from attentionvote.inference.errors import InputError
from attentionvote.inference.estimator import PoseEstimator
from attentionvote.inference.scans.cloud_files import read_cloud
from attentionvote.inference.scans.depth_files import PNG_MAGIC, read_depth
from attentionvote.inference.server.deadline import Deadline, deadline_seconds, late_answer
from attentionvote.inference.server.protocol.answer import answer_parameters, encode_answer, pose_tensors
from attentionvote.inference.server.protocol.request import LENGTH_HEADER, InferRequest, parse_request
from attentionvote.inference.server.worker.channel import PING, Channel, Message, SharedContent


class Jobs:
    """Does the jobs of a channel.

    Args:
        estimator: of the loaded bundle.
        cell: its camera makes clouds of depth images.
    """

    def __init__(self, estimator: PoseEstimator, cell: Cell) -> None:
        self._estimator, self._cell = estimator, cell

    def do_next(self, channel: Channel, recovered: Callable[[], bool]) -> bool:
        """Wait for a job, do it and answer it; False when it took more memory than it may and did not give it back.

        Args:
            channel: of the jobs.
            recovered: whether the process is as small as before its jobs.

        Raises:
            ChannelClosed: when the server has ended.
        """
        message = channel.receive()
        if message.head["kind"] == PING["kind"]:
            channel.send({"status": 200})
            return True
        channel.send({"begun": True})
        work = _Job(self._estimator, self._cell, channel, message)
        del message
        try:
            head, body = work.answer()
        except InputError as error:
            head, body = _refused(400, "rejected", str(error)), b""
        except MemoryError:
            head, body = _refused(422, "rejected", _TOO_LARGE), b""
        except Exception:
            head, body = {"status": 500, "outcome": "failed", "trace": traceback.format_exc(limit=20)}, b""
        if head["status"] == 422:
            gc.collect()
            head["ends"] = not recovered()
        with SharedContent.of(body) as content:
            channel.send(head | {"seconds": work.seconds}, content if body else None)
        return not head.get("ends")


_TOO_LARGE = (
    "the body must be readable within the server's memory for one request, but it needs more: crop or thin the cloud "
    "out, or start the server with a larger --job-memory-mb"
)


def _refused(status: int, outcome: str, sentence: str) -> dict[str, Any]:
    return {"status": status, "outcome": outcome, "error": sentence}


class _Job:
    """One request's work."""

    def __init__(self, estimator: PoseEstimator, cell: Cell, channel: Channel, message: Message) -> None:
        self.seconds: dict[str, float] = {}
        self._estimator, self._cell, self._channel = estimator, cell, channel
        self._head, self._body = message
        self._deadline = Deadline(self._head["budget_s"], self._head["start"])

    def answer(self) -> tuple[dict[str, Any], bytes]:
        """Head and body of the answer."""
        begun = time.monotonic()
        asked, arguments = self._read()
        parsed = time.monotonic()
        self.seconds["parse"] = parsed - begun
        left = max(self._deadline.remaining_s(), 0.0)
        answer = self._estimator.estimate(**arguments, deadline_s=left)
        self.seconds["estimate"] = time.monotonic() - parsed
        head: dict[str, Any] = {"status": 200, "outcome": "ok", "points": answer.points_given}
        head["withheld"] = answer.poses_withheld
        if isinstance(answer, Abstention):
            head |= {"outcome": "abstained", "reason": answer.reason}
            if answer.reason == "deadline_exceeded":
                sentence = self._deadline.sentence("the request was worked on")
                abstention = answer.to_dict() | late_answer(sentence)
                return head | {"status": 504, "outcome": "deadline", "error": sentence, "abstention": abstention}, b""
        head["detections"] = len(answer.detections) if isinstance(answer, Estimate) else 0
        plain = answer.to_dict()
        if asked is None:
            return head | {"headers": {"Content-Type": "application/json"}}, _json(plain)
        body, length = self._encoded(asked, plain)
        kind = "application/json" if length is None else "application/octet-stream"
        return head | {
            "headers": {"Content-Type": kind} | ({} if length is None else {LENGTH_HEADER: str(length)})
        }, body

    def _read(self) -> tuple[InferRequest | None, Mapping[str, Any]]:
        """The protocol's request (None: the body is a file), and the estimator's arguments."""
        if self._head["kind"] == "infer":
            asked = parse_request(bytes(self._body), self._head["header_length"])
            if asked.deadline_ms is not None:
                most = self._head["most_deadline_ms"]
                self._deadline.budget_s = deadline_seconds("parameter deadline_ms", asked.deadline_ms, most)
                self._channel.send({"budget_s": self._deadline.budget_s})
            return asked, {"points": asked.points}
        body = self._body
        if bytes(body[: len(PNG_MAGIC)]) != PNG_MAGIC:
            return None, {"points": self._cell.cloud.metres(read_cloud(body, "the body"))}
        if self._cell.camera is None:
            raise InputError(
                "a depth image needs its camera, got none: start the server with --cell and a camera in it"
            )
        return None, {"depth": read_depth(body, "the body"), "camera": self._cell.camera}

    def _encoded(self, asked: InferRequest, answer: Mapping[str, Any]) -> tuple[bytes, int | None]:
        """The protocol's answer and the length of its JSON part (None: there is nothing else)."""
        digest, card = self._estimator.digest, self._estimator.card
        parameters = answer_parameters(answer, card.part.name, digest)
        tensors = pose_tensors(answer["poses"], card.classes)
        return encode_answer(card.part.name, answer["model"], asked.id, parameters, tensors, asked.outputs)


def _json(content: Mapping[str, Any]) -> bytes:
    return json.dumps(content, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
