"""The story of a part's champion: who moved it, when, from where to where, and why.

make history OBJECT=connecting_rod [ARGS="last=10"]
"""

from __future__ import annotations

import logging
from time import localtime, strftime
from typing import Any

from attentionvote.command.entry import command, configuring
from attentionvote.command.tables import show_table
from attentionvote.workflows.settings import HistorySettings

log = logging.getLogger("attentionvote.history")


def run(cfg: HistorySettings) -> dict[str, Any]:
    """Read the log, show it; the same as data."""
    from attentionvote.registry.history import History, counting
    from attentionvote.registry.promotion import stand
    from attentionvote.registry.versions import Versions

    with configuring():
        versions = Versions(cfg.tracking.store, cfg.object.name)
        history = History(versions)
        standing = stand(versions, history, carry_out=False)
        events = history.events()
    counted = {event.number for event in counting(events)}
    rows, cells = [], []
    for event in events[-cfg.last :]:
        void = event.moves and event.number not in counted
        kind = f"{event.kind}, void" if void else event.kind
        when = strftime("%Y-%m-%d %H:%M", localtime(event.when_s))
        cells.append((when, kind, str(event.version), str(event.before or ""), event.who, event.why))
        rows.append(
            {
                "number": event.number,
                "decision": event.kind,
                "counts": not void,
                "version": event.version,
                "before": event.before,
                "bundle": event.digest,
                "who": event.who,
                "when_s": event.when_s,
                "why": event.why,
                "facts": dict(event.facts),
            }
        )
    champion = standing.champion.number if standing.champion else None
    if events:
        show_table(("when", "decision", "version", "before", "who", "why"), cells, versions.name)
    log.info("%s: %s", versions.name, f"the champion is version {champion}" if champion else "there is no champion")
    if standing.astray:
        log.warning("%s", standing.astray)
    return {"stage": "history", "object": cfg.object.name, "model": versions.name, "champion": champion, "events": rows}


if __name__ == "__main__":
    command(HistorySettings, run)
