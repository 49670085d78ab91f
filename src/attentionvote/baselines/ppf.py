"""Point pair features (Drost et al., CVPR 2010) as OpenCV's ``ppf_match_3d`` has them, for every part in a bin.

What we found out about the module (OpenCV 5.0.0; read in its sources, held by tests/baselines/test_opencv.py where a
test is cheap), and what is done about it:

* The one length that depends on units is the clustering's: poses are averaged within ``relativeSamplingStep`` *units of
  the data*, whatever their rotation (its threshold for angles comes out as 30 radians). In metres, .05 are 5 cm: the
  answers are means of unrelated poses. ``setSearchParams`` is not bound in Python. So clouds are handed over in a unit
  so small that nothing is merged, and ``hypotheses.merged`` does what the paper describes. With OpenCV's own merging
  at 5 % D, average precision was a tenth of that with none (connecting rod, two scenes: .013 and .112).
* ``relativeSceneDistance`` is a share of the *scene's* bounding box, axis by axis, not of the model's diameter as its
  documentation says. A bin is two to four parts wide, so the usual .05 thins a scene far more than the model. Here both
  clouds are thinned to the same voxel first, and the grid is made fine enough to leave them alone.
* ``relativeDistanceStep`` is not read: the distance step is ``relativeSamplingStep`` of the box's diagonal.
* Every insertion into the hash table walks its chain, and flat parts make chains long: a thinned model of some hundred
  points is trained in seconds, the 2,575 points of OpenCV's own sampling (connecting rod, .05) not in ten minutes.
* ICP registers the whole model against the whole scene, so hidden sides are pulled onto the cloud. Here only the points
  that face the camera are registered, against the cloud around the pose. Its residual is of the points that it kept
  and does not rank poses; ``fit`` does.

The method has patents (EP 2385483, US 8830229); it is here to be measured, not shipped.
"""

from __future__ import annotations

import math
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from attentionvote.baselines.clouds import Detections, checked, surface, thinned
from attentionvote.baselines.hypotheses import apart, fits, merged, placed
from attentionvote.baselines.opencv import surface_matching, threads
from attentionvote.baselines.settings import PpfSettings
from attentionvote.geometry.pose import transform
from attentionvote.part import Part

Array = NDArray[np.float64]
_MODEL_POINTS, _FIT_POINTS = 30_000, 1_500
_LEAST_POINTS = 30  # fewer determine no pose
_MOST_CELLS = 200  # along an edge of OpenCV's grid: 200 MB
_UNITS_PER_DIAMETER = 1000.0  # OpenCV merges poses within ``sampling`` of a unit: nothing
_ICP_TOLERANCE, _ICP_REJECTION, _ICP_LEVELS = 0.005, 2.5, 4  # OpenCV's defaults, fewer levels for few points


class PpfDetector:
    """Finds every instance of one part by point pair features; trained when made.

    Args:
        part: what to look for; its symmetry says which poses are the same.
        settings: of the search.
        threads: of OpenCV. Voting runs on one in any case.

    Raises:
        ValueError: when OpenCV with its surface matching is missing.
    """

    def __init__(self, part: Part, settings: PpfSettings | None = None, threads: int = 1) -> None:
        self.part, self.settings, self.threads = part, settings or PpfSettings(), threads
        self._cv2: ModuleType = surface_matching()
        low, high = part.vertices.min(axis=0), part.vertices.max(axis=0)
        self._center = (low + high) / 2
        self._reach = float(np.linalg.norm(part.vertices - self._center, axis=1).max())
        self._unit = _UNITS_PER_DIAMETER / part.diameter
        rng = np.random.default_rng(0)
        self._model = surface(part, _FIT_POINTS, rng)
        model = thinned(surface(part, _MODEL_POINTS, rng), self.settings.sampling * part.diameter)
        self.model_points = len(model)
        # The second argument is not read by OpenCV; the third is the number of angles.
        step = self.settings.sampling
        self._matcher: Any = self._cv2.ppf_match_3d.PPF3DDetector(step, step, self.settings.angles)
        self._matcher.trainModel(self._scaled(model))

    def detect(self, points: NDArray[np.floating], normals: NDArray[np.floating] | None) -> Detections:
        """Every instance in a cloud, best score first; none when the cloud is too small to tell.

        Args:
            points: ``(P, 3)`` metres, camera frame, parts only (as the network's input).
            normals: ``(P, 3)`` unit vectors towards the camera (``geometry.pointcloud.estimate_normals``).

        Raises:
            ValueError: when normals are missing, shapes disagree or a number is not finite.
        """
        cloud = checked(points, normals, "point pair features")
        if len(cloud) < _LEAST_POINTS:
            return Detections(np.zeros((0, 4, 4)), np.zeros(0))
        settings, diameter = self.settings, self.part.diameter
        with threads(self._cv2, self.threads):
            poses, scores = merged(
                *self.votes(cloud[:, :3], cloud[:, 3:]),
                self._center,
                self.part.symmetry,
                settings.merge_distance * diameter,
                math.radians(settings.merge_degrees),
            )
            poses, scores = poses[: settings.hypotheses], scores[: settings.hypotheses]
            if settings.icp_iterations:
                poses = self.refined(poses, cloud)
        if settings.score == "fit":
            scores = fits(poses, self._model, cKDTree(cloud[:, :3]), settings.fit_distance * diameter)
        separate = apart(poses, scores, self._center, settings.separation * diameter)
        return Detections(poses[separate], scores[separate])

    def votes(self, points: NDArray[np.floating], normals: NDArray[np.floating]) -> tuple[Array, Array]:
        """What OpenCV's ``match`` answers: a pose ``(R, 4, 4)`` in metres and its votes ``(R,)`` a reference point."""
        voxel = self.settings.sampling * self.part.diameter
        scene = thinned(checked(points, normals, "point pair features"), voxel)
        extent = np.ptp(scene[:, :3], axis=0)
        if len(scene) < _LEAST_POINTS or extent.max() <= 0:
            return np.zeros((0, 4, 4)), np.zeros(0)
        # OpenCV divides by the extent of every axis: a plane at right angles to one would be cells of 0 / 0.
        scene[0, :3] += np.where(extent < 0.01 * voxel, 0.01 * voxel, 0).astype(np.float32)
        cells = min(math.ceil(extent.max() / voxel), _MOST_CELLS)
        # Half a cell more: OpenCV cuts 1 / share down to a whole number.
        matches = self._matcher.match(
            self._scaled(scene), min(1.0, 1 / (self.settings.reference_step + 0.5)), 1 / (cells + 0.5)
        )
        poses = np.array([np.asarray(pose.pose) for pose in matches], dtype=np.float64).reshape(-1, 4, 4)
        poses[:, :3, 3] /= self._unit
        good = np.isfinite(poses).all(axis=(1, 2))
        votes = np.array([pose.numVotes for pose in matches], dtype=np.float64)
        return _rigid(poses[good]), votes[good]

    def refined(self, poses: Array, cloud: NDArray[np.float32]) -> Array:
        """Poses ``(R, 4, 4)`` after OpenCV's ICP against a cloud ``(P, 6)``; a pose that it cannot move stays."""
        icp = self._cv2.ppf_match_3d.ICP(self.settings.icp_iterations, _ICP_TOLERANCE, _ICP_REJECTION, _ICP_LEVELS)
        cloud = cloud[:: math.ceil(len(cloud) / self.settings.icp_points)]
        tree = cKDTree(cloud[:, :3])
        moved = poses.copy()
        for i, pose in enumerate(poses):
            near = tree.query_ball_point(pose[:3, :3] @ self._center + pose[:3, 3], 1.2 * self._reach)
            model = placed(self._model, pose)
            if min(len(near), len(model)) < _LEAST_POINTS:
                continue
            _, _, step = icp.registerModelToScene(self._scaled(model), self._scaled(cloud[near]))
            step = np.array(step, dtype=np.float64)
            step[:3, 3] /= self._unit
            if np.isfinite(step).all():
                moved[i] = step @ pose
        return _rigid(moved)

    def _scaled(self, cloud: NDArray[np.float32]) -> NDArray[np.float32]:
        """Points and normals ``(P, 6)`` in OpenCV's unit."""
        scaled = np.ascontiguousarray(cloud, dtype=np.float32).copy()
        scaled[:, :3] *= np.float32(self._unit)
        return scaled


def _rigid(poses: Array) -> Array:
    """The nearest rigid poses: OpenCV's products of float matrices are rotations to a few digits only."""
    u, _, v = np.linalg.svd(poses[:, :3, :3])
    u[:, :, 2] *= np.linalg.det(u @ v)[:, None]
    return transform(u @ v, poses[:, :3, 3])
