"""The book of open connections: never more than the process has file handles for, and the newest always gets in."""

from __future__ import annotations

import logging
import resource
import time
from typing import TYPE_CHECKING

from attentionvote.inference.server.json_logs import say
from attentionvote.inference.server.metrics import Closed, Metrics

if TYPE_CHECKING:
    from attentionvote.inference.server.network.connection import CellConnection

HEALTH_CONNECTIONS = 8
_MOST_CONNECTIONS, _FEWEST_CONNECTIONS = 256, 8
_MOST_HANDLES = 4096
# Beside connections: listener, event loop, log, state folder, two workers and two more while a bundle is exchanged,
# and the files of that bundle.
_RESERVED_HANDLES = 56
_SAY_AGAIN_S = 60.0


def raise_handle_limit() -> int:
    """Let the process have more file handles, as far as it may; how many that are."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = _MOST_HANDLES if hard == resource.RLIM_INFINITY else min(hard, _MOST_HANDLES)
    if soft != resource.RLIM_INFINITY and soft < most:
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
        return most
    return _MOST_HANDLES if soft == resource.RLIM_INFINITY else soft


def connection_limit(handles: int, requests: int) -> int:
    """How many connections these file handles allow.

    Args:
        handles: of the process.
        requests: that may be inside; each holds its body beside its connection.
    """
    room = handles - _RESERVED_HANDLES - HEALTH_CONNECTIONS
    return max(_FEWEST_CONNECTIONS, min(_MOST_CONNECTIONS, room - min(requests, room // 2)))


class ConnectionBook:
    """The open connections. Lives on the event loop.

    Args:
        most: how many may be open; a few more are for questions about health only.
        metrics: shows how many are, and counts those that the server ended.
    """

    def __init__(self, most: int, metrics: Metrics) -> None:
        self.most = most
        self.entries: set[CellConnection] = set()
        self._metrics = metrics
        self._quiet_until: dict[str, float] = {}

    def admit(self, entry: CellConnection) -> bool:
        """Enter a new connection; where all places are taken, the longest silent one without a request gives way.

        Returns:
            Whether there is a place for it.
        """
        if len(self.entries) >= self.most:
            self.make_room()
        if len(self.entries) >= self.most + HEALTH_CONNECTIONS:
            return False
        entry.spare = len(self.entries) >= self.most
        self.entries.add(entry)
        self._metrics.connections.set(len(self.entries))
        return True

    def health_only(self, entry: CellConnection) -> bool:
        """Whether a connection may ask about health only: it was let in beyond the limit, which still is exceeded."""
        entry.spare = entry.spare and len(self.entries) > self.most
        return entry.spare

    def remove(self, entry: CellConnection) -> None:
        """A connection has ended."""
        self.entries.discard(entry)
        self._metrics.connections.set(len(self.entries))

    def make_room(self) -> None:
        """End the longest silent connection without a request, if there is one."""
        idle = [entry for entry in self.entries if not entry.busy]
        if not idle:
            return
        longest = min(idle, key=lambda entry: entry.silent_since)
        self.closed("silent")
        self.say_once("connections", f"{self.most} connections are open: the longest silent one gives way to a new one")
        self.remove(longest)
        longest.give_way()

    def closed(self, reason: Closed) -> None:
        """Count a connection that the server ended."""
        self._metrics.connections_closed.labels(reason).inc()

    def say_once(self, event: str, sentence: str) -> None:
        """A warning that may come up a thousand times a second: one line a minute."""
        now = time.monotonic()
        if now >= self._quiet_until.get(event, now):
            self._quiet_until[event] = now + _SAY_AGAIN_S
            say(event, sentence, logging.WARNING)
