"""Roll a champion back: the one before it, or a former champion by its version, serves again.

    make rollback OBJECT=connecting_rod [TO=3] [ARGS="why='misses parts at the wall'"]

Nothing is measured, so it takes seconds; the version must still be there, whole, and signed by the trusted key.
"""

from __future__ import annotations

import logging
import tempfile
from pathlib import Path
from typing import Any

from attentionvote.command.entry import command, configuring
from attentionvote.command.errors import Refused
from attentionvote.workflows.settings import RollbackSettings

log = logging.getLogger("attentionvote.rollback")


def run(cfg: RollbackSettings) -> dict[str, Any]:
    """Choose, check, move; what is champion now."""
    from attentionvote.registry.history import History
    from attentionvote.registry.promotion import Superseded, move, stand, target
    from attentionvote.registry.versions import Versions
    from attentionvote.tracking.server_check import store_failures
    from attentionvote.tracking.store import shown
    from attentionvote.workflows.evaluate.job import trusted_key

    with configuring():
        key = trusted_key(cfg.trusted_key)
        versions = Versions(cfg.tracking.store, cfg.object.name)
        history = History(versions)
        standing = stand(versions, history)
        if standing.astray:
            log.warning("%s", standing.astray)
        version = target(versions, standing, cfg.to)
        with tempfile.TemporaryDirectory(prefix="attentionvote-") as folder:
            versions.fetch(version, Path(folder), key)
    before = standing.champion.number if standing.champion else None
    answer = {
        "stage": "rollback",
        "object": cfg.object.name,
        "model": versions.name,
        "version": version.number,
        "bundle": version.digest,
        "champion": before,
        "before": before,
    }
    try:
        with store_failures(shown(versions.uri)):
            move(versions, history, standing, "rollback", version, cfg.why)
    except Superseded as error:
        raise Refused(str(error), answer) from error
    log.info("%s: version %d is the champion again, instead of %s", cfg.object.name, version.number, before or "none")
    return answer | {"champion": version.number}


if __name__ == "__main__":
    command(RollbackSettings, run)
