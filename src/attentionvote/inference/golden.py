"""The self-test of a cell: every golden cloud of a bundle must give the poses it gave when the bundle was made."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry.symmetry import Symmetry
from attentionvote.inference.answer import Estimate
from attentionvote.inference.bundles.bundle import Bundle, GoldenCloud
from attentionvote.inference.errors import BundleError, InputError
from attentionvote.inference.estimator import PoseEstimator

TRANSLATION_TOLERANCE = 0.001
ROTATION_TOLERANCE = math.radians(1.0)


def clear_confidence(threshold: float) -> float:
    """From which confidence on a pose cannot miss the threshold by rounding: 0.1 above, less where 1 is near."""
    return threshold + (min(0.1, 0.25 * (1 - threshold)) if threshold < 1 else 0.1 * threshold)


def self_test(estimator: PoseEstimator, bundle: Bundle) -> list[str]:
    """What is wrong with the answers to the golden clouds, one sentence each; empty when all are as expected.

    A pose must come back under the same name within 1 mm and 1 degree, least over its part's symmetries. Poses whose
    confidence is near the threshold (below ``clear_confidence``) may come and go: another processor rounds differently.

    Args:
        estimator: of the bundle; its crop is not applied, golden clouds hold parts only.
        bundle: with the clouds.
    """
    try:
        clouds = bundle.golden()
    except BundleError as error:
        return [str(error)]
    symmetries = [Symmetry(**part.symmetry) for part in bundle.card.each_part]
    return [problem for cloud in clouds for problem in _problems(estimator, cloud, symmetries)]


def _problems(estimator: PoseEstimator, cloud: GoldenCloud, symmetries: Sequence[Symmetry]) -> list[str]:
    try:
        answer = estimator.estimate_parts_only(cloud.points)
    except (InputError, RuntimeError) as error:
        return [f"golden cloud {cloud.name} could not be estimated: {error}"]
    detections = answer.detections if isinstance(answer, Estimate) else ()
    poses = np.array([d.camera_from_part for d in detections]).reshape(-1, 4, 4)
    clear = clear_confidence(estimator.card.confidence_threshold)
    named = np.array([estimator.card.classes.index(d.part) for d in detections], dtype=np.int64)
    translation, rotation = _errors_by_part(cloud, poses, named, symmetries)
    good = (translation <= TRANSLATION_TOLERANCE) & (rotation <= ROTATION_TOLERANCE)
    # The expected poses choose their nearest answers, the clearest first; an answer serves one of them.
    free = np.ones(len(poses), dtype=bool)
    problems = []
    for i in np.argsort(-cloud.confidence, kind="stable"):
        fitting = np.flatnonzero(good[i] & free)
        if len(fitting):
            free[fitting[np.argmin(translation[i, fitting])]] = False
        elif cloud.confidence[i] >= clear:
            problems.append(_missing(cloud, int(i), translation[i], rotation[i]))
    for j in np.flatnonzero(free):
        if detections[j].confidence >= clear:
            where = ", ".join(f"{1000 * x:.1f}" for x in poses[j, :3, 3])
            problems.append(
                f"golden cloud {cloud.name} gave a pose at ({where}) mm with confidence "
                f"{detections[j].confidence:.2f} that was not there when the bundle was made"
            )
    return problems


def _errors_by_part(
    cloud: GoldenCloud, poses: NDArray[np.float64], named: NDArray[np.int64], symmetries: Sequence[Symmetry]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """``pose_errors`` by the symmetry of each expected pose's part; infinite between poses of different parts.

    A bundle without ids, or with a class that no card describes, has one symmetry for all.
    """
    if len(symmetries) == 1:
        return pose_errors(cloud.camera_from_part, poses, symmetries[0])
    translation = np.full((len(cloud.camera_from_part), len(poses)), np.inf)
    rotation = translation.copy()
    for kind, symmetry in enumerate(symmetries):
        pairs = np.ix_(cloud.part_ids == kind, named == kind)
        of_part = cloud.camera_from_part[cloud.part_ids == kind], poses[named == kind]
        translation[pairs], rotation[pairs] = pose_errors(*of_part, symmetry)
    return translation, rotation


def _missing(cloud: GoldenCloud, index: int, translation: NDArray[np.float64], rotation: NDArray[np.float64]) -> str:
    demand = f"golden cloud {cloud.name} must give pose {index} with confidence {cloud.confidence[index]:.2f} again"
    if not np.isfinite(translation).any():
        return f"{demand}, but gave no pose {'under its name' if len(translation) else 'at all'}"
    nearest = int(np.argmin(translation))
    return (
        f"{demand} within 1 mm and 1 degree, but the nearest is off by {1000 * translation[nearest]:.2f} mm "
        f"and {math.degrees(rotation[nearest]):.2f} degrees"
    )


def pose_errors(
    expected: NDArray[np.float64], actual: NDArray[np.float64], symmetry: Symmetry
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distances in metres and angles in radians ``(E, F)`` between poses ``(E, 4, 4)`` and ``(F, 4, 4)``.

    Angles are least over the symmetries; for a body of revolution between the axes, of at most 90 degrees with flip.
    """
    translation = np.linalg.norm(expected[:, None, :3, 3] - actual[None, :, :3, 3], axis=-1)
    return translation, symmetry.angle(expected[:, None, :3, :3], actual[None, :, :3, :3])
