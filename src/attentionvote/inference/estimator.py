"""The estimator: a cloud or a depth image in, poses or an abstention out. One verified bundle, one session."""

from __future__ import annotations

import time
from pathlib import Path
from types import EllipsisType, TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.inference.answer import DIGEST_LENGTH, Abstention, Detection, Estimate, detections_from
from attentionvote.inference.bundles.bundle import Bundle, Trusted, load_bundle
from attentionvote.inference.bundles.signature import PUBLIC_NAME, keys_folder
from attentionvote.inference.errors import DeadlineExceeded, InputError
from attentionvote.inference.preparation import Crop, Prepared, TooFewPoints, find_neighbors, prepare
from attentionvote.inference.runtime import Session
from attentionvote.inference.scans.depth_files import CameraIntrinsics

__all__ = ["Abstention", "Detection", "Estimate", "InputError", "PoseEstimator"]


class PoseEstimator:
    """Estimates the poses of a bundle's part.

    Calls may overlap: nothing of a call is kept.

    Args:
        bundle: a loaded bundle, or the folder of one.
        threads: of one run of the graph.
        crop: the inside of the bin; None: the clouds hold parts only.
        trusted: whose signature a folder's bundle must have: a public key, its file, or None for anybody's; left out:
            ``signing.pub`` in ``keys_folder()``. A loaded bundle has been checked already.

    Raises:
        BundleError: when the bundle cannot be trusted or loaded.
        ValueError: when ``threads`` is no positive number.
    """

    def __init__(
        self,
        bundle: Bundle | Path | str,
        *,
        threads: int = 1,
        crop: Crop | None = None,
        trusted: Trusted | EllipsisType = ...,
    ) -> None:
        if not isinstance(bundle, Bundle):
            key = keys_folder() / PUBLIC_NAME if isinstance(trusted, EllipsisType) else trusted
            bundle = load_bundle(bundle, key)
        self.card: ModelCard = bundle.card
        self.digest: str = bundle.digest
        self.crop = crop
        self._session: Session | None = Session(bundle.model, bundle.card, threads)

    def estimate(
        self,
        points: NDArray[Any] | None = None,
        *,
        depth: NDArray[Any] | None = None,
        camera: CameraIntrinsics | None = None,
        deadline_s: float | None = None,
    ) -> Estimate | Abstention:
        """Poses of the parts in a cloud, or in a depth image with its camera.

        Args:
            points: ``(P, 3)`` or organised ``(H, W, 3)``, metres, camera frame.
            depth: ``(H, W)``, see ``CameraIntrinsics``.
            camera: of the depth image.
            deadline_s: seconds from now; when they have passed there is an abstention. The graph is stopped at once,
                the preparation before its next step (of some tenths of a second at most).

        Raises:
            InputError: when the input cannot be used.
        """
        return self._estimate(points, depth, camera, deadline_s, self.crop)

    def estimate_parts_only(self, points: NDArray[Any]) -> Estimate | Abstention:
        """The same for a cloud without background, such as a golden one: no crop.

        Raises:
            InputError: when the input cannot be used.
        """
        return self._estimate(points, None, None, None, None)

    def close(self) -> None:
        """Let the session go; runs that have begun still end."""
        self._session = None

    def __enter__(self) -> PoseEstimator:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _estimate(
        self,
        points: NDArray[Any] | None,
        depth: NDArray[Any] | None,
        camera: CameraIntrinsics | None,
        deadline_s: float | None,
        crop: Crop | None,
    ) -> Estimate | Abstention:
        session = self._session
        if session is None:
            raise RuntimeError("the estimator is closed: make another")
        clock = _Clock(deadline_s)
        facts: dict[str, Any] = {
            "part": self.card.part.name,
            "model": self.digest[:DIGEST_LENGTH],
            "points_given": 0,
            "points_used": 0,
        }
        try:
            cloud = _cloud(points, depth, camera)
            if isinstance(cloud, np.ndarray):  # preparation refuses anything else
                facts["points_given"] = depth.size if depth is not None else cloud.size // 3
            clock.lap("read")
            prepared = _prepared(cloud, self.card, crop, clock, depth is not None)
            facts |= {"points_used": prepared.used, "warnings": prepared.warnings}
            clock.lap("prepare")
            neighbors = find_neighbors(prepared.points, session.layout)
            outputs = session.run(prepared.points, prepared.normals, clock.left(), neighbors)
            clock.lap("graph")
        except TooFewPoints as error:
            facts |= {"points_used": error.used, "seconds": clock.seconds()}
            return Abstention(**facts, reason="too_few_points", message=str(error))
        except DeadlineExceeded:
            message = f"the deadline of {deadline_s:g} s passed before there was an answer"
            return Abstention(**facts, seconds=clock.seconds(), reason="deadline_exceeded", message=message)
        found, unsound = detections_from(outputs, self.card)
        if unsound:
            sentence = f"{unsound} proposals above the thresholds had no finite pose and were left out"
            facts["warnings"] = (*prepared.warnings, sentence)
        facts["seconds"] = clock.seconds()
        if found:
            return Estimate(**facts, detections=found)
        message = (
            f"no proposal reached the thresholds (heat {self.card.peak_threshold:g}, "
            f"confidence {self.card.confidence_threshold:g})"
        )
        return Abstention(**facts, reason="nothing_found", message=message)


class _Clock:
    """Seconds by stage, and what is left until the deadline."""

    def __init__(self, deadline_s: float | None) -> None:
        if deadline_s is not None and not deadline_s >= 0:
            raise InputError(f"deadline_s must be seconds of at least 0, got {deadline_s}")
        self._deadline_s = deadline_s
        self._start = self._last = time.monotonic()
        self._seconds: dict[str, float] = {}

    def lap(self, stage: str) -> None:
        """End a stage; DeadlineExceeded when it ended too late."""
        now = time.monotonic()
        self._seconds[stage], self._last = now - self._last, now
        self.check()

    def check(self) -> None:
        """DeadlineExceeded when no time is left."""
        left = self.left()
        if left is not None and left <= 0:
            raise DeadlineExceeded(f"the deadline of {self._deadline_s} s has passed")

    def left(self) -> float | None:
        """Seconds until the deadline; None without one."""
        return None if self._deadline_s is None else self._deadline_s - (time.monotonic() - self._start)

    def seconds(self) -> dict[str, float]:
        """Of every stage that ended, and the total."""
        return {**self._seconds, "total": time.monotonic() - self._start}


def _prepared(cloud: NDArray[Any], card: ModelCard, crop: Crop | None, clock: _Clock, from_depth: bool) -> Prepared:
    try:
        return prepare(cloud, card, crop, between=clock.check)
    except InputError as error:
        if from_depth:
            raise InputError(f"{error} (a depth image: depth_scale and depth_offset of its camera decide)") from error
        raise


def _cloud(
    points: NDArray[Any] | None, depth: NDArray[Any] | None, camera: CameraIntrinsics | None
) -> NDArray[np.floating]:
    if (points is None) == (depth is None):
        got = "neither" if points is None else "both"
        raise InputError(f"estimate needs either points or a depth image with its camera, got {got}")
    if depth is not None:
        if camera is None:
            raise InputError("a depth image needs its camera, got none: give fx, fy, cx, cy and depth_scale")
        return camera.points(depth)
    if camera is not None:
        raise InputError("a camera belongs to a depth image, got one with points: leave it out")
    assert points is not None
    return points
