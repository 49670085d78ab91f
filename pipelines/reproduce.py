"""Make a registered version again: its scenes and its training from what the store keeps of it, and compare.

    make reproduce OBJECT=connecting_rod [VERSION=3]

VERSION left out is the champion. Says what differs from then (commit, packages, processor). On the same machine scenes,
weights and figures are equal to the bit; elsewhere the figures lie within the interval of their paired difference, or
the exit code is 1. Everything goes below outputs/reproduce; interrupted, the same command goes on.
"""

from __future__ import annotations

from typing import Any

from attentionvote.command.entry import command
from attentionvote.workflows.settings import ReproduceSettings


def run(cfg: ReproduceSettings) -> dict[str, Any]:
    """Fetch, compare, train, compare; what is equal."""
    from attentionvote.workflows.reproduce import reproduce

    return reproduce(cfg)


if __name__ == "__main__":
    command(ReproduceSettings, run)
