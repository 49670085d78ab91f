"""Places and deadlines, without a server."""

from __future__ import annotations

import math
import time

import pytest

from attentionvote.inference.server.admission import Deadline, Gate, deadline_of
from attentionvote.inference.server.metrics import Metrics
from attentionvote.inference.server.refusal import Refusal


def test_one_runs_and_a_few_wait() -> None:
    metrics = Metrics()
    gate = Gate(2, metrics)
    places = [gate.enter() for _ in range(3)]
    assert metrics.waiting._value.get() == 3
    with pytest.raises(Refusal, match="at most 3 requests may run or wait") as caught:
        gate.enter()
    assert caught.value.status == 503
    assert caught.value.headers == {"Retry-After": "1", "X-Retry-After-Ms": "200"}
    places[1].leave()
    places[1].leave()  # leaving twice frees one place
    gate.enter()
    with pytest.raises(Refusal):
        gate.enter()
    assert metrics.waiting._value.get() == 3


def test_retry_after_follows_what_estimates_take() -> None:
    gate = Gate(0, Metrics())
    for _ in range(100):
        gate.took(3.4)
    gate.enter()
    with pytest.raises(Refusal) as caught:
        gate.enter()
    assert caught.value.headers == {"Retry-After": "4", "X-Retry-After-Ms": "3400"}


def test_a_deadline_counts_from_the_arrival() -> None:
    arrived = time.monotonic() - 0.5
    deadline = deadline_of("it", 600.0, arrived)
    assert deadline.remaining_s() == pytest.approx(0.1, abs=0.05)
    assert deadline.elapsed_s() == pytest.approx(0.5, abs=0.05)
    assert Deadline(0.4, arrived).remaining_s() < 0
    refusal = deadline.exceeded("it waited")
    assert (refusal.status, refusal.outcome) == (504, "deadline")
    assert refusal.content["reason"] == "deadline_exceeded"
    assert "the deadline of 600 ms passed while it waited" in refusal.sentence


@pytest.mark.parametrize("given", [0.0, 0.99, -1.0, 60_001.0, math.nan, math.inf])
def test_a_deadline_out_of_range_is_refused(given: float) -> None:
    with pytest.raises(Refusal, match="it must be between 1 and 60000 milliseconds, got") as caught:
        deadline_of("it", given)
    assert caught.value.status == 400
