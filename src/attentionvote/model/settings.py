"""Settings of the network: the group ``conf/model``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from attentionvote.section import check
from attentionvote.setting import ChoicesOf, Identity, Setting, SettingError

_FUSIONS = ChoicesOf("attentionvote.model.fusion", "FUSIONS", ("aml", "amx", "pn"), classes=True)
Widths = tuple[int, ...]
LEVELS = 4  # set abstractions of the backbone, with radii r, 2r, 3r and 6r


@dataclass(frozen=True)
class RefinementSettings:
    """The refinement of each pose against the points around it: not the paper's."""

    points: Annotated[int, Setting("Points around a pose.", low=1, high=100_000)]
    widths: Annotated[Widths, Setting("Of the point features.", low=1, high=100_000)]
    head: Annotated[Widths, Setting("Hidden widths of the head.", low=1, high=100_000)]


@dataclass(frozen=True, kw_only=True)
class NetworkSettings:
    """The network's sizes and choices; lengths are shares of D, so one preset fits parts of every size.

    Raises:
        SettingError: when a setting is out of its range.
    """

    centers: Annotated[Widths, Setting("Points of each set abstraction.", low=1, high=1_000_000)]
    neighbors: Annotated[Widths, Setting("Neighbours of each ball query.", low=1, high=100_000)]
    widths: Annotated[
        tuple[Widths, ...], Setting("Of the MLP of each set abstraction (section 3.5).", low=1, high=100_000)
    ]
    propagation: Annotated[Widths, Setting("Widths of the feature propagations.", low=1, high=100_000)]
    residual: Annotated[bool, Setting("Whether each set abstraction has a residual block.")]
    radius_fraction: Annotated[float, Setting("r, a share of D; levels have r, 2r, 3r and 6r.", above=0, high=10)]
    voxel_fraction: Annotated[float, Setting("Voxel of the heatmap, a share of D.", above=0, high=10)]
    base_radius: Annotated[float | None, Setting("r in metres; null = radius_fraction times D.", above=0, high=10)] = (
        None
    )
    voxel_size: Annotated[
        float | None, Setting("Voxel in metres; null = voxel_fraction times D.", above=0, high=10)
    ] = None
    voting_radius: Annotated[
        float | None, Setting("In which votes are gathered, metres; null = r.", above=0, high=10)
    ] = None
    test_voting_radius: Annotated[
        float | None,
        Setting("The same in validation, test and cell (Table 9), metres; null = test_voting_share.", above=0, high=10),
    ] = None
    test_voting_share: Annotated[
        float,
        Setting("The same as a share of the training's radius.", above=0, high=10, identity=Identity.CHANGED),
    ] = 1.0
    voting: Annotated[Widths, Setting("Hidden widths of the voting module.", low=1, high=100_000)]
    vote_rotation: Annotated[
        bool, Setting("Whether every vote also predicts its instance's rotation: not the paper's.")
    ] = False
    proposal_source: Annotated[
        str,
        Setting("heatmap (section 3.2) or fps (farthest points of the votes, VoteNet's).", choices=("heatmap", "fps")),
    ] = "heatmap"
    proposals: Annotated[int, Setting("K.", low=1, high=1_000_000)]
    peak_window: Annotated[int, Setting("Voxels to each side that a peak must top.", low=1, high=100)] = 1
    center_seed: Annotated[
        str, Setting("Seed of a proposal: its voxel's centre, or its votes' mean.", choices=("voxel", "mean"))
    ] = "voxel"
    gathered: Annotated[int, Setting("H, votes gathered for a proposal.", low=1, high=100_000)]
    fusion_kind: Annotated[
        str, Setting("How gathered votes become one feature (Table 8), see model/fusion.py.", choices=_FUSIONS)
    ] = "aml"
    fusion: Annotated[Widths, Setting("Widths of the fusion's MLPs (section 3.5).", low=1, high=100_000)]
    head: Annotated[Widths, Setting("Hidden widths of the head.", low=1, high=100_000)]
    classes: Annotated[int, Setting("NC, parts in the bin; 1 = as many as the object has.", low=1, high=1000)] = 1
    rotation: Annotated[
        str,
        Setting("quaternion (the paper's) or six (Gram-Schmidt of two vectors).", choices=("quaternion", "six")),
    ] = "quaternion"
    confidence: Annotated[
        str,
        Setting(
            "exponential (c = exp(s), Eq. 10) or quality (c = sigmoid(s), the expected quality).",
            choices=("exponential", "quality"),
        ),
    ] = "exponential"
    refinement: Annotated[RefinementSettings | None, Setting("null = none, the paper's form.")] = None
    refinement_steps: Annotated[int, Setting("Refinements in a row.", low=0, high=100)] = 2
    merge_fraction: Annotated[
        float | None,
        Setting("Share of D within which proposals that end in one place are one; null = never.", above=0, high=10),
    ] = None

    def __post_init__(self) -> None:
        check(self)
        for name in ("centers", "neighbors", "widths"):
            if len(getattr(self, name)) != LEVELS:
                raise SettingError(f"{name} must have {LEVELS} entries, one a level; got {list(getattr(self, name))}")
