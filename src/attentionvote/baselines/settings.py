"""Settings of the classical baselines."""

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


@dataclass(frozen=True)
class FpfhSettings:
    """How a bin is searched by fast point feature histograms; lengths are shares of D.

    The defaults were chosen on scenes of the first validation cycle of the connecting rod (seed 0, 0.3 mm of noise), by
    average precision at 10 % D. On two of them (14 and 22 parts; voxel .04, every 10th reference, 10,000 iterations) a
    ``feature_radius`` of .3 gave .52, .2 .59, .15 .66, .12 .80, .1 .59; with .2, features of a single direction .45, a
    ``neighborhood`` of .5 .52, one match .51. Two scenes scatter by a tenth and more: with .12, 40 directions gave .63.
    On four (10, 14, 18 and 22 parts): voxel .04 with 3,000 iterations .56, with 10,000 .75 (12 s of a processor a
    scene); voxel .03 with every 20th reference .77 (9 s), with 20,000 iterations as well .84 (16 s), with these and
    every 40th .75 (9 s).

    Raises:
        SettingError: when a setting is out of its range.
    """

    sampling: Annotated[
        float, Setting("Voxel to which model and scene are thinned, a share of D.", low=0.02, high=0.2)
    ] = 0.03
    feature_radius: Annotated[
        float, Setting("What a histogram sees around its point, a share of D.", low=0.04, high=1)
    ] = 0.12
    views: Annotated[
        int, Setting("Directions that the model's features are computed for, of what faces them.", low=4, high=200)
    ] = 20
    matches: Annotated[int, Setting("Points of the model that a point of the scene may be.", low=1, high=20)] = 2
    reference_step: Annotated[int, Setting("Every so-many-th scene point is a reference.", low=1, high=1000)] = 20
    neighborhood: Annotated[
        float, Setting("Radius around a reference in which a part is looked for, a share of D.", low=0.05, high=2)
    ] = 0.35
    iterations: Annotated[int, Setting("Of RANSAC around a reference.", low=100, high=10_000_000)] = 20_000
    inlier_distance: Annotated[
        float, Setting("Of a pose's points RANSAC counts those within this share of D.", low=0.001, high=0.5)
    ] = 0.05
    edge_similarity: Annotated[
        float, Setting("Least ratio of the lengths of an edge of a sample in model and scene.", low=0, high=1)
    ] = 0.8
    normal_degrees: Annotated[
        float, Setting("Most that the normals of a sample may differ by, turned into the pose.", low=1, high=180)
    ] = 30.0
    merge_distance: Annotated[
        float, Setting("Poses nearer than this and merge_degrees are one hypothesis, a share of D.", low=0, high=1)
    ] = 0.1
    merge_degrees: Annotated[float, Setting("See merge_distance.", low=0, high=180)] = 30.0
    hypotheses: Annotated[int, Setting("Most of them that are refined, the best by fit.", low=1, high=10_000)] = 250
    icp_iterations: Annotated[int, Setting("Most of each of the two ICPs.", low=1, high=1000)] = 30
    icp_distance: Annotated[
        float,
        Setting("Farthest pair of the first ICP, a share of D; a third of it in the second.", low=0.003, high=0.5),
    ] = 0.05
    icp_points: Annotated[int, Setting("Most points of the scene that ICP sees.", low=100, high=1_000_000)] = 15_000
    fit_distance: Annotated[float, Setting("Met means within this share of D.", low=0.001, high=0.5)] = 0.01
    separation: Annotated[
        float, Setting("Of two poses with centres nearer than this share of D the better is given.", low=0, high=1)
    ] = 0.1

    def __post_init__(self) -> None:
        check(self)
