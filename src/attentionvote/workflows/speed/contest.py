"""One row of ``make bench``: a fast path and its references, measured in turn in one run, their results compared."""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

LEAST_TURN_S = 0.02  # of one contestant's turn: shorter calls are repeated
MOST_CALLS = 200


class Unequal(Exception):
    """The fast path and a reference answered differently; the message says by how much."""


class NotMeasured(Exception):
    """A row cannot be measured here; the message says why in a few words."""


@dataclass(frozen=True)
class Goal:
    """What a row has to reach.

    Args:
        text: as the table shows it.
        most: limit of the fast path's time, as a multiple of the reference's, or in milliseconds an item.
        against: name of the reference; None: an absolute limit.
    """

    text: str
    most: float
    against: str | None = None


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Args:
        name: chosen by ``rows=NAME``.
        title: what is measured.
        prepare: ``module:function`` that makes the ``Contest``; imported when the row's turn comes.
        goals: all have to be met, and those of the contest.
        item: what the time is of.
        cores: of the arithmetic. One: processor time. More: what passes on the clock.
        arguments: of ``prepare``, after the material.
        cuda: whether it is about a GPU; not measured without.
    """

    name: str
    title: str
    prepare: str
    goals: tuple[Goal, ...] = ()
    item: str = "call"
    cores: int = 1
    arguments: tuple[Any, ...] = ()
    cuda: bool = False

    @property
    def clock(self) -> str:
        """What is measured."""
        if self.cuda:
            return "wall, 1 GPU"
        return "processor, 1 thread" if self.cores == 1 else f"wall, {self.cores} cores"


@dataclass(frozen=True)
class Contest:
    """What a row runs.

    Args:
        fast: the path that the product takes.
        references: by name, what it is measured beside.
        compare: given the results of ``fast`` and of every reference, says in what they are equal; raises ``Unequal``.
        size: how much of what, for the table.
        items: items of one call.
        goals: those that depend on sizes.
        absent: references that are not installed here.
    """

    fast: Callable[[], Any]
    references: Mapping[str, Callable[[], Any]]
    compare: Callable[[Any, Mapping[str, Any]], str]
    size: str
    items: int = 1
    goals: tuple[Goal, ...] = ()
    absent: tuple[str, ...] = ()


def measure(row: Row, contest: Contest, rounds: int, progress: Callable[[], object] = lambda: None) -> dict[str, Any]:
    """Run the contestants in turn.

    Every contestant is run once for its result; results are compared before anything is measured. A round then gives
    each one turn, so that what else the machine does meets all alike, and quotients are of the same round.

    Args:
        row: says which clock counts and what has to be reached.
        contest: the contestants.
        rounds: turns of each; medians are kept.
        progress: called after each round.

    Returns:
        times in milliseconds an item, quotients, goals, and whether they are met (None: a reference is missing).

    Raises:
        Unequal: when the results differ.
    """
    clock = time.process_time if row.cores == 1 and not row.cuda else time.perf_counter
    run = {"fast": contest.fast, **contest.references}

    def turn(name: str, calls: int) -> tuple[float, Any]:
        start = clock()
        for _ in range(calls):
            result = run[name]()
        return (clock() - start) / calls, result

    results: dict[str, Any] = {}
    calls: dict[str, int] = {}
    for name in run:
        _, results[name] = turn(name, 1)
        seconds = turn(name, 1)[0] if rounds > 1 else LEAST_TURN_S
        calls[name] = min(MOST_CALLS, max(1, round(LEAST_TURN_S / max(seconds, 1e-9))))
    fast = results.pop("fast")
    equal = contest.compare(fast, results)
    del fast, results
    each: dict[str, list[float]] = {name: [] for name in run}
    gc.collect()
    gc.disable()
    try:
        for _ in range(rounds):
            for name in run:
                each[name].append(turn(name, calls[name])[0] * 1e3 / contest.items)
            progress()
    finally:
        gc.enable()
    goals = [_judged(goal, each) for goal in (*row.goals, *contest.goals)]
    return {
        "row": row.name,
        "title": row.title,
        "size": contest.size,
        "clock": row.clock,
        "item": row.item,
        "ms": statistics.median(each["fast"]),
        "rounds_ms": each["fast"],
        "references": {
            name: {"ms": statistics.median(each[name]), "rounds_ms": each[name], "factor": factor(each, name)}
            for name in contest.references
        },
        "absent": list(contest.absent),
        "equal": equal,
        "goals": goals,
        "met": met(goals),
    }


def factor(each: Mapping[str, list[float]], name: str) -> float:
    """How many times as long as the fast path a reference takes: the median over the rounds."""
    return statistics.median(b / max(a, 1e-12) for a, b in zip(each["fast"], each[name], strict=True))


def met(goals: list[dict[str, Any]]) -> bool | None:
    """Whether every goal is met; None when one of the others cannot be judged."""
    judged = [goal["met"] for goal in goals]
    if False in judged:
        return False
    return None if None in judged or not judged else True


def _judged(goal: Goal, each: Mapping[str, list[float]]) -> dict[str, Any]:
    if goal.against is None:
        value: float | None = statistics.median(each["fast"])
    else:
        value = 1 / factor(each, goal.against) if goal.against in each else None
    return {"text": goal.text, "against": goal.against, "value": value, "most": goal.most,
            "met": None if value is None else value <= goal.most}  # fmt: skip
