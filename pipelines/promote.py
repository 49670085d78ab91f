"""Promote an exported model: register it, measure it beside the champion, make it champion if every gate holds.

    make promote OBJECT=connecting_rod [ARGS="why='new gripper' gates.latency_p95_ms=500"]

The gates are in conf/promote.yaml. Whatever the outcome, every gate with its figures goes to the terminal, to the
registered version's tags and to the history (`make history`). A model that fails a gate stays a candidate; exit code 1.
"""

from __future__ import annotations

from typing import Any

from attentionvote.command.entry import command, configuring
from attentionvote.workflows.settings import PromoteSettings


def run(cfg: PromoteSettings) -> dict[str, Any]:
    """Measure, judge, register, move; the decision."""
    from attentionvote.tracking.server_check import store_failures
    from attentionvote.tracking.store import shown
    from attentionvote.workflows.promote import PromotionJob

    with configuring():
        job = PromotionJob.find(cfg)
    with store_failures(shown(job.versions.uri)):
        return job.already() or job.run()


if __name__ == "__main__":
    command(PromoteSettings, run)
