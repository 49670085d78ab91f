"""Settings of the timings: ``conf/bench.yaml``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from attentionvote.command.configuration import VerbSettings
from attentionvote.command.sections import SEED
from attentionvote.section import Target
from attentionvote.setting import Setting


@dataclass(frozen=True, kw_only=True)
class SpeedSettings(VerbSettings):
    """Which rows are timed, and how."""

    verb: ClassVar[str] = "bench"
    object: Target
    rows: Annotated[str | None, Setting("Rows to measure, names with commas between them; null = all of them.")]
    rounds: Annotated[int, Setting("Turns of each contestant; medians are kept.", low=1, high=1000)]
    seed: Annotated[int, SEED]
    compact: Annotated[tuple[str, ...], Setting("Words of the training that the rows called compact are about.")]
    full: Annotated[tuple[str, ...], Setting("Words of the training that the rows called full are about.")]
    batch: Annotated[dict[str, int], Setting("Scenes of one step of each.", low=1, high=1024)]
    page: Annotated[str, Setting("Page whose section is written; page='' = none.")]
