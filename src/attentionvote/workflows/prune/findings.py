"""What a look at the disk ends with: things that nobody refers to, and what could not be judged."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from attentionvote.workflows.prune.holdings import size_of, written_s

# In the order in which they are removed: what refers comes before what it refers to.
KINDS = ("bundle", "training", "checkpoints", "clouds", "scenes", "leftover")


@dataclass(frozen=True)
class Unreferenced:
    """One thing that nobody refers to.

    Attributes:
        kind: one of ``KINDS``, or ``unfinished`` for a training that is only listed.
        part: its part's name.
        path: its folder or file.
        bytes: of all its files.
        age_days: since it was written last.
    """

    kind: str
    part: str
    path: Path
    bytes: int
    age_days: float

    @classmethod
    def of(cls, kind: str, part: str, path: Path, now_s: float) -> Unreferenced:
        """What lies there now."""
        return cls(kind, part, path, size_of(path), round(max(0.0, now_s - written_s(path)) / 86_400, 2))

    def as_dict(self, removed: bool) -> dict[str, Any]:
        """Plain values for the JSON line."""
        entry = {"kind": self.kind, "part": self.part, "path": str(self.path), "bytes": self.bytes}
        return entry | {"age_days": self.age_days, "removed": removed}


@dataclass
class Findings:
    """What nobody refers to, unfinished trainings that are old, and sentences about what could not be judged."""

    unreferenced: list[Unreferenced] = field(default_factory=list)
    unfinished: list[Unreferenced] = field(default_factory=list)
    unjudged: list[str] = field(default_factory=list)
