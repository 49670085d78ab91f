"""Places and deadlines, without a server."""

from __future__ import annotations

import pytest

from attentionvote.inference.server.admission import Gate
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
