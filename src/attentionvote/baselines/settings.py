"""Settings of the classical baseline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from attentionvote.section import check
from attentionvote.setting import Setting

SCORES = ("votes", "fit")


@dataclass(frozen=True)
class PpfSettings:
    """How a bin is searched; lengths are shares of D.

    The defaults were chosen on two validation scenes of the connecting rod (14 and 22 parts, 0.3 mm of noise). Average
    precision at 10 % D: as voted .43, with ICP and ``fit`` .75; with sampling .07, which votes in about a third of the
    time, .31 and .72. 40 angles lost, and so did half the reference points. A ``fit`` of .3 is a fair working point.

    Raises:
        SettingError: when a setting is out of its range.
    """

    sampling: Annotated[
        float, Setting("Voxel to which model and scene are thinned, a share of D.", low=0.02, high=0.2)
    ] = 0.05
    angles: Annotated[int, Setting("Steps of a full turn that angles are quantised in.", low=8, high=90)] = 30
    reference_step: Annotated[int, Setting("Every so-many-th scene point votes for a pose.", low=1, high=100)] = 5
    merge_distance: Annotated[
        float, Setting("Poses nearer than this and merge_degrees are one hypothesis, a share of D.", low=0, high=1)
    ] = 0.1
    merge_degrees: Annotated[float, Setting("See merge_distance.", low=0, high=180)] = 30.0
    hypotheses: Annotated[
        int, Setting("Most of them that are looked at further, those with most votes.", low=1, high=10_000)
    ] = 100
    icp_iterations: Annotated[int, Setting("Of OpenCV's ICP; 0 leaves the poses as voted.", low=0, high=1000)] = 30
    icp_points: Annotated[int, Setting("Most points of the scene that ICP sees.", low=100, high=1_000_000)] = 15_000
    score: Annotated[
        str,
        Setting("votes (as OpenCV and the paper rank) or fit (share of visible model points met).", choices=SCORES),
    ] = "votes"
    fit_distance: Annotated[float, Setting("Met means within this share of D.", low=0.001, high=0.5)] = 0.01
    separation: Annotated[
        float, Setting("Of two poses with centres nearer than this share of D the better is given.", low=0, high=1)
    ] = 0.1

    def __post_init__(self) -> None:
        check(self)
