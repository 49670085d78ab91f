"""The deadline of a request, from its first byte on; server and worker count it by the same clock."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from typing import Any

from attentionvote.inference.errors import InputError


@dataclass
class Deadline:
    """Seconds that a request may take, counted from its arrival.

    Attributes:
        budget_s: all of it.
        start: of the monotonic clock, which all processes of a machine share.
    """

    budget_s: float
    start: float = field(default_factory=time.monotonic)

    def remaining_s(self) -> float:
        """What is left; negative when it has passed."""
        return self.start + self.budget_s - time.monotonic()

    def elapsed_s(self) -> float:
        """What has been used."""
        return time.monotonic() - self.start

    def sentence(self, doing: str) -> str:
        """That it has passed while something was done."""
        return f"the deadline of {self.budget_s * 1e3:.0f} ms passed while {doing}: nothing was computed to its end"


def late_answer(sentence: str) -> dict[str, Any]:
    """What a client gets beside the sentence: an abstention, so that nobody takes a late answer for an empty bin."""
    return {"answer": "abstention", "reason": "deadline_exceeded", "message": sentence, "poses": []}


def deadline_seconds(what: str, milliseconds: float, most_ms: float) -> float:
    """A client's number as seconds, the server's longest where it asks for more.

    Args:
        what: the header or parameter, for the sentence.
        milliseconds: the number.
        most_ms: the longest deadline that the server allows.

    Raises:
        InputError: when it is none.
    """
    if not (math.isfinite(milliseconds) and milliseconds >= 1.0):
        raise InputError(f"{what} must be at least 1 millisecond, got {milliseconds:g}")
    return min(milliseconds, most_ms) / 1e3
