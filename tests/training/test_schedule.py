"""Learning rates and ramps by step."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.training.schedule import Schedule


def test_the_papers_rate_falls_tenfold_after_five_and_after_ten_epochs() -> None:
    factor = Schedule().rate_factor(total_steps=150, steps_per_epoch=10)
    by_epoch = [factor(10 * epoch) for epoch in range(15)]
    assert by_epoch == pytest.approx([1.0] * 5 + [0.1] * 5 + [0.01] * 5)
    assert factor(49) == 1.0


def test_cosine_falls_from_one_to_zero() -> None:
    factor = Schedule(shape="cosine").rate_factor(100, 10)
    rates = [factor(step) for step in range(130)]
    assert rates[0] == 1.0
    assert rates[50] == pytest.approx(0.5)
    assert rates[25] == pytest.approx(0.5 * (1 + math.sqrt(0.5)))
    assert rates[100:] == pytest.approx([0.0] * 30)
    assert all(a >= b for a, b in itertools.pairwise(rates))


@given(st.sampled_from(["step", "cosine", "constant"]), st.integers(1, 30), st.integers(0, 100))
def test_the_rate_rises_in_equal_steps_and_is_then_the_plain_one(shape: str, rise: int, step: int) -> None:
    plain = Schedule(shape=shape).rate_factor(200, 10)  # type: ignore[arg-type]
    rising = Schedule(shape=shape, rise_steps=rise).rate_factor(200, 10)  # type: ignore[arg-type]
    assert rising(step) == pytest.approx(plain(step) * min(1.0, (step + 1) / rise))
    assert rising(step) >= 0


def test_constant_stays() -> None:
    factor = Schedule(shape="constant").rate_factor(10, 1)
    assert {factor(step) for step in range(50)} == {1.0}


def test_votes_alone_come_first_and_the_rest_rises_to_its_full_weight() -> None:
    schedule = Schedule(vote_steps=3, ramp_steps=4)
    assert [schedule.ramp(step) for step in range(9)] == pytest.approx([0, 0, 0, 0.25, 0.5, 0.75, 1, 1, 1])


def test_without_a_warm_up_everything_acts_from_the_first_step() -> None:
    assert Schedule().ramp(0) == 1.0
    assert Schedule(ramp_steps=0).ramp(0) == 1.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"shape": "linear"}, "^shape must be one of step, cosine, constant; got 'linear'"),
        ({"milestones": [10, 5]}, r"milestones must be rising epochs, got \[10, 5\]"),
        ({"milestones": [5, 5]}, r"milestones must be rising epochs, got \[5, 5\]"),
    ],
)
def test_impossible_schedules_are_refused(arguments: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Schedule(**arguments)
