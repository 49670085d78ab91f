"""A row: contestants take turns, quotients and goals, results compared before anything is measured."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from attentionvote.workflows.speed.contest import Contest, Goal, Row, Unequal, measure


def busy(seconds: float, log: list[str], name: str) -> Callable[[], str]:
    """A call that keeps the processor busy for a while."""

    def run() -> str:
        log.append(name)
        end = time.process_time() + seconds
        while time.process_time() < end:
            pass
        return name

    return run


def row(*goals: Goal, cores: int = 1) -> Row:
    return Row("row", "a row", "nowhere:nothing", goals, cores=cores)


@pytest.mark.parametrize("cores", [1, 2])
def test_contestants_take_turns_and_goals_are_judged(cores: int) -> None:
    log: list[str] = []
    contest = Contest(
        busy(0.02, log, "fast"),
        {"slow": busy(0.06, log, "slow")},
        lambda fast, others: f"{fast} beside {', '.join(others.values())}",
        "1",
        items=2,
        goals=(Goal("at least twice", 1 / 2, "slow"),),
        absent=("other",),
    )
    asked = row(Goal("<= 1 s", 1000.0), Goal("<= other", 1.0, "other"), cores=cores)
    found = measure(asked, contest, rounds=3)
    assert log[-6:] == ["fast", "slow"] * 3
    assert found["equal"] == "fast beside slow"
    assert found["ms"] > 9
    assert found["clock"] == ("processor, 1 thread" if cores == 1 else "wall, 2 cores")
    assert found["references"]["slow"]["factor"] > 2 or cores == 2
    assert [goal["met"] for goal in found["goals"]][:2] == [True, None]
    assert found["absent"] == ["other"]
    assert found["met"] is None or cores == 2


def test_one_missed_goal_is_a_missed_row() -> None:
    log: list[str] = []
    contest = Contest(busy(0.02, log, "fast"), {}, lambda *_: "", "1")
    found = measure(row(Goal("<= 1 ms", 1.0), Goal("<= absent", 1.0, "absent")), contest, rounds=1)
    assert (found["met"], found["goals"][0]["met"]) == (False, False)


def test_short_calls_are_repeated() -> None:
    log: list[str] = []
    measure(row(), Contest(busy(0.001, log, "fast"), {}, lambda *_: "", "1"), rounds=2)
    assert len(log) >= 2 + 2 * 10


def test_different_results_are_never_measured() -> None:
    log: list[str] = []

    def compare(*_: object) -> str:
        raise Unequal("3 differ")

    with pytest.raises(Unequal, match="3 differ"):
        measure(row(), Contest(busy(0.0, log, "fast"), {}, compare, "1"), rounds=1)
    assert log == ["fast"]
