"""Settings that do not change a result: left out where a configuration is identified."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

# What may change between two calls that mean the same training: it does not change what is learned.
NOT_IDENTITY = (
    *("resume", "force", "workers", "executor", "cluster", "tracking", "outputs", "root"),
    *("data.workers", "trainer.threads"),
)
NETWORK = "attentionvote.model.AttentionVote"  # the class that conf/model named before 0.2


def without(composed: Mapping[str, Any], keys: tuple[str, ...] = NOT_IDENTITY) -> dict[str, Any]:
    """A copy of plain settings without these dotted keys; those that are not there are passed over."""
    plain = deepcopy(dict(composed))
    for key in keys:
        section, _, leaf = key.rpartition(".")
        (plain.get(section, {}) if section else plain).pop(leaf, None)
    if "model" in plain:  # a training keeps its identity
        plain["model"]["_target_"] = NETWORK
    return plain
