"""Specification of a scene set: everything that determines it, its digest, and its folder."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field, is_dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from attentionvote.part import Parts
from attentionvote.section import identifying
from attentionvote.setting import Identity, Setting
from attentionvote.simulation.camera import CameraSettings
from attentionvote.simulation.drop_settings import BinSettings, DropSettings

FORMAT_VERSION = 1


@dataclass(frozen=True)
class SimulationSettings:
    """Piles of parts in a bin, by physics: sequential drops, every pile kept is a scene (``conf/simulation``)."""

    seed: Annotated[int, Setting("Of all piles.", low=0, high=2**32 - 1)]
    cycles: Annotated[
        dict[str, int], Setting("Drop cycles per split; splits never share a cycle.", low=1, high=1_000_000)
    ]
    drop_counts: Annotated[tuple[int, ...], Setting("The pile is kept after these drops.", low=1, high=200)]
    bin: BinSettings
    camera: CameraSettings
    drop: DropSettings
    visibility_stride: Annotated[
        int, Setting("Visibility is measured on every so-many-th pixel in both directions.", low=1, high=8)
    ]
    keep_every: Annotated[
        dict[str, int],
        Setting(
            "Per split: a cycle keeps every so-many-th of drop_counts, each cycle begins one later; splits not named "
            "keep all.",
            low=1,
            high=200,
            identity=Identity.CHANGED,
        ),
    ] = field(default_factory=dict)
    pile_share: Annotated[
        dict[str, float],
        Setting(
            "Per split: a cycle ends at this share of the largest of drop_counts; splits not named go to the end.",
            above=0,
            high=1,
            identity=Identity.CHANGED,
        ),
    ] = field(default_factory=dict)


@dataclass(frozen=True)
class SceneSetSpec:
    """Everything that determines the content of a scene set.

    Args:
        part_digest: of the part, or of the set of parts.
        split: name of the split; it enters the seeds, so splits never share a cycle.
        cycles: number of drop cycles.
        seed: any non-negative integer.
        drop_counts: a cycle's pile is kept after these drops.
        bin, camera, drop: their settings.
        visibility_stride: visibility is measured on every so-many-th pixel.
        keep_every: a cycle keeps every so-many-th of ``drop_counts``, at least one, see ``counts_of``; 1 keeps all.
            Consecutive piles of a cycle are nearly one picture, so as many scenes of more cycles say more. What is kept
            is as it would be in the full cycle.
        pile_share: no pile of more than this share of the last of ``drop_counts``, but at least one. The bin has the
            size of the full cycle. Of a cycle of 30 drops the last eight take half of the time.

    Raises:
        ValueError: when a setting is impossible.
    """

    part_digest: str
    split: str
    cycles: int
    seed: int = 0
    drop_counts: tuple[int, ...] = (6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30)
    bin: BinSettings = field(default_factory=BinSettings)
    camera: CameraSettings = field(default_factory=CameraSettings)
    drop: DropSettings = field(default_factory=DropSettings)
    visibility_stride: int = 2
    format_version: int = FORMAT_VERSION
    keep_every: int = 1
    pile_share: float = 1.0

    def __post_init__(self) -> None:
        counts = tuple(int(c) for c in self.drop_counts)
        object.__setattr__(self, "drop_counts", counts)
        if not self.split or not self.split.replace("_", "").replace("-", "").isalnum():
            raise ValueError(f"split must be a word of letters, digits, - and _, got {self.split!r}")
        if self.cycles < 1:
            raise ValueError(f"cycles must be at least 1, got {self.cycles}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")
        if not counts or counts[0] < 1 or counts[-1] > 200 or list(counts) != sorted(set(counts)):
            raise ValueError(f"drop_counts must be increasing numbers within 1..200, got {list(counts)}")
        if not 1 <= self.visibility_stride <= 8:
            raise ValueError(f"visibility_stride must lie in 1..8, got {self.visibility_stride}")
        if self.keep_every < 1:
            raise ValueError(f"keep_every must be at least 1, got {self.keep_every}")
        if not 0 < self.pile_share <= 1:
            raise ValueError(f"pile_share must be above 0 and at most 1, got {self.pile_share}")

    def counts_of(self, cycle: int) -> tuple[int, ...]:
        """After which drops a cycle's pile is kept: cycle 0 begins with the first of ``drop_counts``, cycle 1 with the
        second, and so on in turn, so that ``keep_every`` cycles have all of them between them."""
        low = sum(count <= self.pile_share * self.drop_counts[-1] for count in self.drop_counts)
        counts = self.drop_counts[: max(1, low)]
        return counts[cycle % min(self.keep_every, len(counts)) :: self.keep_every]

    @property
    def scenes(self) -> int:
        """Number of scenes when no bin is full before its last drop."""
        return sum(len(self.counts_of(cycle)) for cycle in range(self.cycles))

    def as_dict(self) -> dict:
        """Plain JSON values, as written into the manifest; ``keep_every`` and ``pile_share`` only where they keep less
        than all, later fields of bin and drops only where they change something, so that digests of before they came
        are the same."""
        sections = {name: identifying(value) for name, value in vars(self).items() if is_dataclass(value)}
        plain: dict = json.loads(json.dumps(asdict(self) | sections))
        for name in ("keep_every", "pile_share"):
            if plain[name] == 1:
                del plain[name]
        return plain

    def digest(self) -> str:
        """Sha256 of the specification."""
        return hashlib.sha256(json.dumps(self.as_dict(), sort_keys=True).encode()).hexdigest()

    def cycle_seed(self, cycle: int) -> np.random.SeedSequence:
        """Seed of one cycle, from (seed, split, cycle) alone."""
        split_key = int.from_bytes(hashlib.sha256(self.split.encode()).digest()[:8], "little")
        return np.random.SeedSequence([self.seed, split_key, cycle])


def scene_set_directory(root: Path, part_name: str, spec: SceneSetSpec) -> Path:
    """Where the scene set of ``spec`` lives: ``root/<part>/<split>-<first 12 of the digest>``."""
    return root / part_name / f"{spec.split}-{spec.digest()[:12]}"


def scene_set_specs(part: Parts, settings: SimulationSettings) -> dict[str, SceneSetSpec]:
    """Specification of every split.

    Args:
        part: the part, or the set of parts in the bin.
        settings: of ``conf/simulation``.

    Raises:
        ValueError: when a setting is impossible.
    """
    s = settings
    shared = s.seed, s.drop_counts, s.bin, s.camera, s.drop, s.visibility_stride
    return {
        split: SceneSetSpec(
            part.digest, split, cycles, *shared,
            keep_every=s.keep_every.get(split, 1), pile_share=s.pile_share.get(split, 1.0),
        )
        for split, cycles in s.cycles.items()
    }  # fmt: skip
