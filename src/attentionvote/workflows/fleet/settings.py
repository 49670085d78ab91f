"""Settings of a fleet: ``conf/fleet.yaml``, those of a training among them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from attentionvote.setting import Setting
from attentionvote.workflows.train.settings import TrainSettings

THREADS = Setting("Cores of each at a time; null = the cores of this machine, shared.", low=1, high=1024)
RETRIES = Setting("How often one whose process died is taken up again.", low=0, high=1000)


@dataclass(frozen=True, kw_only=True)
class FleetSettings(TrainSettings):
    """The parts of a fleet, and how they are worked on."""

    verb: ClassVar[str] = "fleet"
    objects: Annotated[str, Setting("Names with commas between them, or all: every part whose mesh is there.")]
    export: Annotated[tuple[str, ...], Setting("Words for the export of every part.", empty=True)]
    evaluate: Annotated[tuple[str, ...], Setting("Words for the evaluation of every part.", empty=True)]
    threads: Annotated[int | None, THREADS]
    retries: Annotated[int, RETRIES]
    fleets: Annotated[str, Setting("Where leaderboard and logs lie.")]
