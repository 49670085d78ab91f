"""Deadlines, without a server."""

from __future__ import annotations

import math
import time

import pytest

from attentionvote.inference.errors import InputError
from attentionvote.inference.server.admission import too_late
from attentionvote.inference.server.deadline import Deadline, deadline_seconds


def test_a_deadline_counts_from_the_arrival() -> None:
    deadline = Deadline(0.6, time.monotonic() - 0.5)
    assert deadline.remaining_s() == pytest.approx(0.1, abs=0.05)
    assert deadline.elapsed_s() == pytest.approx(0.5, abs=0.05)
    assert Deadline(0.4, deadline.start).remaining_s() < 0
    refusal = too_late(deadline, "it waited")
    assert (refusal.status, refusal.outcome) == (504, "deadline")
    assert refusal.content["reason"] == "deadline_exceeded"
    assert refusal.content["poses"] == []
    assert "the deadline of 600 ms passed while it waited" in refusal.sentence


def test_more_than_the_server_allows_is_shortened() -> None:
    assert deadline_seconds("it", 1.0, 10_000.0) == 0.001
    assert deadline_seconds("it", 9_999.0, 10_000.0) == 9.999
    assert deadline_seconds("it", 1e9, 10_000.0) == 10.0


@pytest.mark.parametrize("milliseconds", [0.0, 0.99, -1.0, math.nan, math.inf])
def test_what_is_no_deadline_is_refused(milliseconds: float) -> None:
    with pytest.raises(InputError, match="it must be at least 1 millisecond, got"):
        deadline_seconds("it", milliseconds, 10_000.0)
