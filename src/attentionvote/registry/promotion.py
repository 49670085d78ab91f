"""Moving the champion as a transaction: read where it stands, decide, append to the history, move the alias.

A process that is killed between the last two steps leaves a decision without its move; whoever comes next carries it
out first. A champion that somebody moved by hand is reported and counts as it stands.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import localtime, strftime

from attentionvote.registry.history import Event, History, Kind, counting
from attentionvote.registry.versions import Version, Versions

log = logging.getLogger(__name__)


class Superseded(ValueError):
    """Somebody else moved the champion while this was decided: the decision is void."""


@dataclass(frozen=True)
class Standing:
    """Where a part's champion stands.

    Attributes:
        champion: what cells follow; None before the first promotion, or when the version was deleted.
        base: number of the last move, which the next one must name.
        previous: version numbers that a rollback would come to, the next one last.
        ever: version numbers that have been champion, oldest first.
        astray: a sentence when the alias is not where the history left it; empty otherwise.
        since_s: when the champion was made it, seconds since 1970; None when there is none or it was changed by hand.
    """

    champion: Version | None
    base: int
    previous: tuple[int, ...]
    ever: tuple[int, ...]
    astray: str = ""
    since_s: float | None = None


def stand(versions: Versions, history: History, carry_out: bool = True) -> Standing:
    """Read where the champion stands.

    Args:
        versions, history: of the part's model.
        carry_out: whether a move that was decided, but not carried out, is carried out first.
    """
    moves = counting(history.events())
    existing = {version.number: version for version in versions.all()}
    unfinished = bool(moves) and not moves[-1].done
    if unfinished and carry_out:
        if moves[-1].version in existing:
            log.warning("the %s was decided but not carried out: the champion is moved now", phrase(moves[-1]))
            _carry_out(versions, history, existing)
        history.mark_done(moves[-1])
    champion = versions.champion()
    stack: list[int] = []
    for move in moves:
        # A rollback comes back to an earlier champion: what was above it is no way back any more.
        if move.kind == "rollback" and move.version in stack:
            del stack[stack.index(move.version) :]
        if move.version in stack:
            stack.remove(move.version)
        stack.append(move.version)
    now = None if champion is None else champion.number
    if now in stack:  # moved back by hand: what was above it is no way back either
        del stack[stack.index(now) :]
    previous = tuple(number for number in stack if number in existing and number != now)
    astray = ""
    if moves and now != moves[-1].version:
        got = "there is none (was the version deleted?)" if now is None else f"it is version {now}"
        astray = f"the champion must be version {moves[-1].version} by the history, but {got}: it was changed by hand"
        if unfinished and not carry_out:
            astray = (
                f"the {phrase(moves[-1])} was decided but not carried out: `make promote` or `make rollback` does it"
            )
    return Standing(
        champion,
        moves[-1].number if moves else 0,
        previous,
        tuple(dict.fromkeys(move.version for move in moves)),
        astray,
        moves[-1].when_s if moves and now == moves[-1].version else None,
    )


def move(
    versions: Versions,
    history: History,
    standing: Standing,
    kind: Kind,
    version: Version,
    why: str,
    facts: Mapping[str, str] | None = None,
) -> Event:
    """Make a version the champion, if nobody else moved it since ``standing`` was read.

    Raises:
        Superseded: when somebody did; the alias is left alone.
    """
    before = standing.champion.number if standing.champion else None
    event = history.append(kind, version.number, before, version.digest, standing.base, why, facts)
    moves = counting(history.events())
    if event.mark not in [other.mark for other in moves]:
        winner = next(other for other in moves if other.base == standing.base)
        raise Superseded(
            f"the champion of {versions.part} must stay the same during a {kind}, but the {phrase(winner)} came first: "
            "run the same command again to decide against the new champion"
        )
    event = next(other for other in moves if other.mark == event.mark)
    _carry_out(versions, history, {version.number: version for version in versions.all()})
    history.mark_done(event)
    return event


def _carry_out(versions: Versions, history: History, existing: Mapping[int, Version]) -> None:
    """Move the alias to where the last move wants it, and look again: a slow request must not undo a newer decision."""
    while True:
        last = counting(history.events())[-1]
        if last.version in existing:
            versions.set_champion(existing[last.version])
        if counting(history.events())[-1].mark == last.mark:
            return


def target(versions: Versions, standing: Standing, wanted: int | None) -> Version:
    """The version that a rollback makes champion: the one before, or a former champion by its number.

    Raises:
        ValueError: when there is none, with what can be chosen.
    """
    existing = {version.number: version for version in versions.all()}
    now = standing.champion.number if standing.champion else None
    choices = [number for number in standing.ever if number in existing and number != now]
    if wanted is None and standing.previous:
        return existing[standing.previous[-1]]
    if wanted in choices:
        return existing[wanted]
    have = f"one of {', '.join(map(str, choices))}" if choices else "none"
    if wanted is None:
        raise ValueError(
            f"a rollback of {versions.part} needs an earlier champion that still exists, got {have}: promote a model"
        )
    problem = "which is the champion already" if wanted == now else f"which {_no_choice(wanted, standing, existing)}"
    raise ValueError(f"a rollback of {versions.part} must be to a former champion ({have}), got {wanted}, {problem}")


def phrase(event: Event) -> str:
    """An event in a few words."""
    when = strftime("%Y-%m-%d %H:%M", localtime(event.when_s))
    return f"{event.kind} of version {event.version} by {event.who} at {when}"


def _no_choice(wanted: int, standing: Standing, existing: Mapping[int, Version] | Sequence[int]) -> str:
    if wanted not in existing:
        return "was deleted" if wanted in standing.ever else "does not exist"
    return "never was champion: use `make promote`"
