"""Settings of the verb: ``conf/prune.yaml``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from attentionvote.command.configuration import VerbSettings
from attentionvote.command.sections import Store
from attentionvote.setting import Setting


@dataclass(frozen=True, kw_only=True)
class PruneSettings(VerbSettings):
    """Where nobody's data may lie, and whether they go."""

    verb: ClassVar[str] = "prune"
    root: Annotated[str, Setting("Where scene sets and clouds lie.")]
    outputs: Annotated[str, Setting("Where train/, export/, sweep/ ... lie.")]
    also: Annotated[
        tuple[str, ...],
        Setting("Further folders whose trainings, bundles and results refer to the data; they stay.", empty=True),
    ]
    remove: Annotated[bool, Setting("Remove what nobody refers to, instead of showing it.")]
    checkpoints: Annotated[
        bool, Setting("Also the checkpoints of complete trainings: more epochs begin anew without them.")
    ]
    unfinished_days: Annotated[
        float, Setting("Age from which on unfinished trainings are listed; younger ones keep data.", low=0, high=36_500)
    ]
    tracking: Store
