"""The story of a part's champion: an append-only log in the registry itself, and the lock of its transactions.

Events are versions of a second registered model, ``attentionvote-<part>-history``: MLflow numbers versions one after
the other, whoever creates them, so the log has one order, and it stays when aliases move and versions of the model are
deleted. Nothing is ever changed but the mark that an event's alias move was carried out.

Every event that moves the champion names the move it was decided on (``base``). It counts only when no other move came
between: of two promotions at the same time, both decided against the same champion, the one with the lower number
counts and the other is void. Everybody who reads the log comes to the same result, so no lock is held that could be
left behind by a process that was killed.
"""

from __future__ import annotations

import getpass
import json
import socket
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from attentionvote.registry.versions import Versions

Kind = Literal["promote", "refuse", "rollback"]
MOVES = ("promote", "rollback")
_DONE, _TEXT_LIMIT = "done", 5000


@dataclass(frozen=True)
class Event:
    """One entry of the log.

    Attributes:
        number: its place.
        mark: drawn when it was written; a repeated request writes two entries with the same one.
        kind: ``promote``, ``refuse`` (a candidate that failed a gate) or ``rollback``.
        version: registered version that it is about.
        before: the champion's version at the time; None without one.
        digest: of the version's bundle.
        base: number of the last move that the decision knew of; 0 for none.
        who, why: who decided (user@machine), and the reason given.
        when_s: seconds since 1970, by the store's clock.
        done: whether the alias was moved.
        facts: what else was recorded, such as the gates.
    """

    number: int
    mark: str
    kind: Kind
    version: int
    before: int | None
    digest: str
    base: int
    who: str
    why: str
    when_s: float
    done: bool
    facts: Mapping[str, str] = field(default_factory=dict, repr=False)

    @property
    def moves(self) -> bool:
        """Whether it is meant to move the champion."""
        return self.kind in MOVES


class History:
    """The log of one part's model.

    Args:
        versions: the model's versions, which also gives the connection.
    """

    def __init__(self, versions: Versions) -> None:
        self._versions = versions
        self.name = f"{versions.name}-history"

    def events(self) -> list[Event]:
        """Every event, oldest first.

        Raises:
            ValueError: when an entry is none of ours.
        """
        return sorted(map(_event, self._versions.rows(self.name)), key=lambda event: event.number)

    def append(
        self,
        kind: Kind,
        version: int,
        before: int | None,
        digest: str,
        base: int,
        why: str,
        facts: Mapping[str, str] | None = None,
    ) -> Event:
        """Add an event at the end; whether a move counts is known from ``counting`` afterwards."""
        about = f"Append-only story of {self._versions.name}: every version here is one decision, not a model"
        self._versions.create(self.name, {"kind": "history"}, about)
        named = {f"fact.{name}": value[:_TEXT_LIMIT] for name, value in (facts or {}).items()}
        content = {"version": version, "before": before, "digest": digest, "base": base, "who": who(), "why": why}
        content["mark"] = uuid.uuid4().hex
        row = self._versions.client.create_model_version(
            self.name,
            f"attentionvote:///history/{kind}",
            tags={"kind": kind, "event": json.dumps(content), **named},
            description=f"{kind} version {version} (champion was {before or 'none'}): {why}"[:_TEXT_LIMIT],
        )
        return _event(row)

    def mark_done(self, event: Event) -> None:
        """Note that the alias was moved."""
        self._versions.client.set_model_version_tag(self.name, str(event.number), _DONE, "yes")


def counting(events: Sequence[Event]) -> list[Event]:
    """The moves that count, oldest first: each was decided on the one before it."""
    counted: list[Event] = []
    for event in events:
        if event.moves and event.base == (counted[-1].number if counted else 0):
            counted.append(event)
    return counted


def who() -> str:
    """User and machine, as the history names them."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a container without an entry in /etc/passwd
        user = "unknown"
    return f"{user}@{socket.gethostname()}"


def _event(row: Any) -> Event:
    tags, number = dict(row.tags), int(row.version)
    try:
        content, kind = json.loads(tags["event"]), tags["kind"]
        if kind not in get_args(Kind):
            raise ValueError(f"kind {kind!r}")
        return Event(
            number, str(content["mark"]), kind,
            int(content["version"]), None if content["before"] is None else int(content["before"]),
            str(content["digest"]), int(content["base"]), str(content["who"]), str(content["why"]),
            row.creation_timestamp / 1000, tags.get(_DONE) == "yes",
            {name.removeprefix("fact."): value for name, value in tags.items() if name.startswith("fact.")},
        )  # fmt: skip
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"entry {number} of {row.name} must be an event of ours, got something else ({error}): "
            "delete that version in the registry, it was written by hand"
        ) from error
