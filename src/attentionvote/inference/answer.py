"""An estimator's answer: poses, or an abstention with its reason."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from attentionvote.contract import FRAME, UNITS, ModelCard, is_detection
from attentionvote.geometry.pose import matrix_from_quaternion, quaternion_from_matrix, transform

# Why there is no pose, the whole list: too_few_points (an empty bin), nothing_found (nothing above the thresholds),
# deadline_exceeded, blind_sensor (too little of the bin was measured), bin_not_found (the bin is elsewhere), wrong_part
# (what lies there is another part), no_pick (there are poses, but none that the robot can take).
Reason = Literal[
    "too_few_points", "nothing_found", "deadline_exceeded", "blind_sensor", "bin_not_found", "wrong_part", "no_pick"
]
REASONS: tuple[Reason, ...] = get_args(Reason)
DIGEST_LENGTH = 12


class Detection(NamedTuple):
    """One part that was found.

    Attributes:
        camera_from_part: ``(4, 4)`` float64.
        confidence: the network's own measure of the pose.
        part: name of its class.
        heat: of the peak it comes from: how many votes agree on it.
    """

    camera_from_part: NDArray[np.float64]
    confidence: float
    part: str
    heat: float

    def to_dict(self) -> dict[str, Any]:
        """Plain data: the pose as matrix, and as position (metres) and quaternion (w, x, y, z)."""
        return {
            "camera_from_part": self.camera_from_part.tolist(),
            "position": self.camera_from_part[:3, 3].tolist(),
            "quaternion": quaternion_from_matrix(self.camera_from_part[:3, :3]).tolist(),
            "confidence": self.confidence,
            "heat": self.heat,
            "part": self.part,
        }


@dataclass(frozen=True, kw_only=True)
class _Facts:
    """What both kinds of answer say.

    Attributes:
        part: what was looked for.
        model: the first digits of the bundle's digest.
        points_given: places of the cloud or pixels of the image, missing measurements included.
        points_measured: those with a measurement.
        points_used: points left after the crop.
        seconds: by stage, and their ``total``.
        warnings: sentences about an unusual cloud.
        poses_withheld: how many poses were left out because they could not be where the scan was measured.
    """

    part: str
    model: str
    points_given: int
    points_measured: int
    points_used: int
    seconds: Mapping[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    poses_withheld: int = 0

    def _plain(self) -> dict[str, Any]:
        """These as plain data, and what the poses mean."""
        facts: dict[str, Any] = {entry.name: getattr(self, entry.name) for entry in fields(_Facts)}
        facts |= {"seconds": dict(self.seconds), "warnings": list(self.warnings)}
        return {"frame": FRAME, "units": UNITS, **facts}


@dataclass(frozen=True, kw_only=True)
class Estimate(_Facts):
    """Parts were found.

    Attributes:
        detections: most confident first, at least one; the others are those of every answer.
    """

    detections: tuple[Detection, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON, with the list ``poses``."""
        return {"answer": "estimate", "poses": [d.to_dict() for d in self.detections], **self._plain()}


@dataclass(frozen=True, kw_only=True)
class Abstention(_Facts):
    """No pose is answered, and why.

    Attributes:
        reason: one of ``REASONS``.
        message: the reason in a sentence; the others are those of every answer.
    """

    reason: Reason
    message: str

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON; ``poses`` is there and empty."""
        return {"answer": "abstention", "reason": self.reason, "message": self.message, "poses": [], **self._plain()}


def detections_from(outputs: Mapping[str, NDArray[np.float32]], card: ModelCard) -> tuple[tuple[Detection, ...], int]:
    """The graph's proposals that pass the card's thresholds, most confident first.

    Args:
        outputs: of the graph, batch 1.
        card: of the model.

    Returns:
        The detections, and how many more would have passed but have no finite pose.
    """
    heat, confidence = outputs["peak_heat"][0], outputs["confidence"][0]
    center, quaternion = outputs["center"][0].astype(np.float64), outputs["quaternion"][0].astype(np.float64)
    confident = is_detection(heat, confidence, card.peak_threshold, card.confidence_threshold)
    length = np.linalg.norm(quaternion, axis=1)
    sound = np.isfinite(center).all(axis=1) & np.isfinite(length) & (length > 1e-6)
    sound &= np.isfinite(heat) & np.isfinite(confidence)
    index = np.flatnonzero(confident & sound)
    index = index[np.argsort(-confidence[index], kind="stable")]
    poses = transform(matrix_from_quaternion(quaternion[index]), center[index])
    names = outputs["class_logits"][0][index].argmax(axis=1)
    detections = tuple(
        Detection(pose, float(confidence[i]), card.classes[name], float(heat[i]))
        for pose, i, name in zip(poses, index, names, strict=True)
    )
    return detections, int((confident & ~sound).sum())
