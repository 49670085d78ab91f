"""The estimator: a cloud or a depth image in, poses or an abstention out. One verified bundle, one session."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import EllipsisType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.inference.answer import DIGEST_LENGTH, Abstention, Estimate, Reason, detections_from
from attentionvote.inference.blind_sensor import LEAST_SHARE, BlindSensor
from attentionvote.inference.bundles.bundle import Bundle, Trusted, load_bundle
from attentionvote.inference.bundles.signature import PUBLIC_NAME, keys_folder
from attentionvote.inference.crop import Crop
from attentionvote.inference.errors import DeadlineExceeded, InputError
from attentionvote.inference.measured_points import measured_points
from attentionvote.inference.pose_check import plausible
from attentionvote.inference.preparation import TooFewPoints, find_neighbors, prepare
from attentionvote.inference.runtime import Session
from attentionvote.inference.scans.depth_files import CameraIntrinsics
from attentionvote.inference.scans.limits import MOST_POINTS


class PoseEstimator:
    """Estimates the poses of a bundle's part.

    Calls may overlap: nothing of a call is kept.

    Args:
        bundle: a loaded bundle, or the folder of one.
        threads: of one run of the graph.
        crop: the inside of the bin; None: the clouds hold parts only.
        camera: of the cell: how much of the bin a cloud should show. A depth image brings its own.
        most_points: that a cloud may have measured.
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
        camera: CameraIntrinsics | None = None,
        most_points: int = MOST_POINTS,
        trusted: Trusted | EllipsisType = ...,
    ) -> None:
        if not isinstance(bundle, Bundle):
            key = keys_folder() / PUBLIC_NAME if isinstance(trusted, EllipsisType) else trusted
            bundle = load_bundle(bundle, key)
        self.card: ModelCard = bundle.card
        self.digest: str = bundle.digest
        self.crop = crop
        self._camera, self._most_points = camera, most_points
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

    def _measured_by(self, depth: NDArray[Any] | None, camera: CameraIntrinsics | None) -> CameraIntrinsics | None:
        """The camera of a scan, with the size of its images where it is known."""
        if depth is None or camera is None:
            return self._camera
        return replace(camera, width=depth.shape[1], height=depth.shape[0])

    def close(self) -> None:
        """Let the session go; runs that have begun still end."""
        self._session = None

    def __enter__(self) -> PoseEstimator:
        return self

    def __exit__(self, *_: object) -> None:
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
            "points_measured": 0,
            "points_used": 0,
        }
        try:
            cloud = _cloud(points, depth, camera)
            with _naming_the_camera(depth is not None):
                scan = measured_points(cloud, self.card, self._most_points)
                facts["points_given"] = scan.total if depth is None else depth.size
                facts["points_measured"] = scan.measured
                facts["warnings"] = (*scan.warnings, *_sparse(facts, crop))
                clock.lap("read")
                prepared = prepare(scan, self.card, crop, self._measured_by(depth, camera), between=clock.check)
            facts |= {"points_used": prepared.used, "warnings": (*facts["warnings"], *prepared.warnings)}
            clock.lap("prepare")
            neighbors = find_neighbors(prepared.points, session.layout)
            outputs = session.run(prepared.points, prepared.normals, clock.left(), neighbors)
            clock.lap("graph")
        except (TooFewPoints, BlindSensor) as error:
            facts |= {"points_used": error.used, "seconds": clock.seconds()}
            reason: Reason = "blind_sensor" if isinstance(error, BlindSensor) else "too_few_points"
            return Abstention(**facts, reason=reason, message=str(error))
        except DeadlineExceeded:
            message = f"the deadline of {deadline_s:g} s passed before there was an answer"
            return Abstention(**facts, seconds=clock.seconds(), reason="deadline_exceeded", message=message)
        detections, unsound = detections_from(outputs, self.card)
        detections, strange = plausible(detections, prepared.points[0], self.card)
        if withheld := unsound + strange:
            sentence = f"{withheld} poses above the thresholds lie outside the scan or are none, and were left out"
            facts |= {"poses_withheld": withheld, "warnings": (*facts["warnings"], sentence)}
        facts["seconds"] = clock.seconds()
        if detections:
            return Estimate(**facts, detections=detections)
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


@contextmanager
def _naming_the_camera(from_depth: bool) -> Iterator[None]:
    """What is wrong with the points of a depth image is its camera's fault."""
    try:
        yield
    except InputError as error:
        if from_depth:
            raise InputError(f"{error} (a depth image: depth_scale and depth_offset of its camera decide)") from error
        raise


def _sparse(facts: Mapping[str, Any], crop: Crop | None) -> Iterator[str]:
    """A warning when most places have no measurement; with a bin that is looked at more closely."""
    total, measured = facts["points_given"], facts["points_measured"]
    if crop is None and measured < LEAST_SHARE * total:
        yield f"only {measured} of {total} places have a measurement"


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
