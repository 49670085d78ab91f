"""What ``make prune`` does, step by step: look, judge, show, remove on request."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

from attentionvote.command.entry import configuring
from attentionvote.files import locked_folder
from attentionvote.workflows.prune.settings import PruneSettings

log = logging.getLogger("attentionvote.prune")


def run(cfg: PruneSettings) -> dict[str, Any]:
    """Show what nobody refers to, remove it when that is asked for; the JSON line.

    Raises:
        OSError: when something cannot be removed.
    """
    from attentionvote.tracking.store import resolve_store
    from attentionvote.workflows.prune import report
    from attentionvote.workflows.prune.judgement import judge
    from attentionvote.workflows.prune.removal import remove_part

    with configuring():
        resolve_store(cfg.tracking.store)
        for name, folder in [("outputs", cfg.outputs), *(("also", folder) for folder in cfg.also)]:
            if not Path(folder).is_dir():  # without its trainings all data would be nobody's
                raise ValueError(f"{name} must name a folder with results, got {folder!r}, which is none")
    findings = judge(cfg, time.time())
    things = [thing for finding in findings.values() for thing in finding.unreferenced]
    unfinished = [thing for finding in findings.values() for thing in finding.unfinished]
    unjudged = [sentence for finding in findings.values() for sentence in finding.unjudged]
    for sentence in unjudged:
        log.warning("%s", sentence)
    going = [thing for thing in things if cfg.checkpoints or thing.kind != "checkpoints"]
    gone: set[Path] = set()
    if cfg.remove:
        # The folder of logs is one that no judgement looks into.
        with locked_folder(Path(cfg.outputs) / "logs" / "prune", cfg.outputs, "prune"):
            for part in findings:
                gone |= remove_part(cfg, part, [thing for thing in going if thing.part == part])
    freed = [thing for thing in going if thing.path in gone or not cfg.remove]
    report.show(things, unfinished, freed)
    size = report.amount(sum(thing.bytes for thing in freed))
    if cfg.remove:
        log.info("removed: %d of %d, %s", len(freed), len(going), size)
    elif freed:
        log.info("%d things would free %s: make prune ARGS=remove=true removes them", len(freed), size)
    if not cfg.checkpoints and any(thing.kind == "checkpoints" for thing in things):
        log.info("checkpoints stay unless checkpoints=true is said too: more epochs go on from them")
    return report.result(things, unfinished, freed, gone, unjudged, cfg.remove)
