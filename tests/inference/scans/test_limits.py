"""The budget of one input: bytes before they are reserved, seconds of this thread only."""

from __future__ import annotations

import time

import pytest

from attentionvote.inference.scans.limits import Budget


def test_bytes_are_counted_together() -> None:
    budget = Budget(100)
    budget.take(60)
    budget.take(40)
    budget.take(0)
    with pytest.raises(
        ValueError, match=r"^it must unpack to at most 100 bytes, got more: crop or thin it out, or send float32$"
    ):
        budget.take(1)


def test_only_the_threads_own_processor_time_counts() -> None:
    budget = Budget(most_seconds=0.05)
    time.sleep(0.1)
    budget.check_time()
    start = time.thread_time()
    while time.thread_time() - start < 0.06:
        pass
    with pytest.raises(
        ValueError,
        match=r"^it must be read within 0\.05 s of processor time, but it takes longer: send a binary PLY",
    ):
        budget.check_time()
