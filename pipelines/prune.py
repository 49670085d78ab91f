"""Show, or remove, the data, trainings, bundles and checkpoints that nobody refers to.

    make prune
    make prune ARGS=remove=true
    make prune ARGS="remove=true checkpoints=true"

Nothing is removed without remove=true. What cannot be judged, say because the tracking store does not answer, is kept.
"""

from __future__ import annotations

from attentionvote.command.entry import command
from attentionvote.workflows.prune.job import run
from attentionvote.workflows.prune.settings import PruneSettings

if __name__ == "__main__":
    command(PruneSettings, run)
