"""Fast point feature histograms (Rusu et al., ICRA 2009), RANSAC and ICP as Open3D has them, for every part in a bin.

Open3D's registration by features looks for one pose of one cloud in another. A bin holds many parts, each seen from one
side, and what is done about it here is the following.

* Model and scene are thinned to the same voxel. The model's features are computed *as seen*: from ``views`` directions,
  each time of the points that face it only. Features of the whole surface mix both sides of a thin wall, which no
  camera sees.
* Every so-many-th point of the scene is a reference. The scene's points around it, in less than a part's reach, are
  matched to the model's by feature, and RANSAC answers one pose for it. Around most references nothing is found; the
  pose is then some wrong one, which the fit tells.
* The poses are ranked by their fit on the thinned scene, similar ones merged, and the best refined: point-to-plane, of
  the model's points that face the camera against the cloud around them, twice, the second time with a third of the
  distance. ``hypotheses.fits`` scores what comes out, ``hypotheses.apart`` suppresses, as behind PPF.

RANSAC draws its samples from Open3D's one generator, seeded anew at every reference, and its early exit is switched off
(confidence 1): with it the answer may depend on which thread was first. On one thread, the default, everything is the
same to the bit, whatever other processes do.
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
from attentionvote.baselines.open3d import point_cloud, registration, threads
from attentionvote.baselines.settings import FpfhSettings
from attentionvote.geometry.pose import inverse
from attentionvote.part import Part

Array = NDArray[np.float64]
_MODEL_POINTS, _FIT_POINTS = 30_000, 1_500
_RANKING_STEP = 4  # every so-many-th of the latter ranks poses before they are refined
_LEAST_POINTS = 30  # fewer determine no pose
_LEAST_NEAR = 10  # points around a reference, fewer are a crumb
_ICP_CHANGE = 1e-6  # of the share of points met, and of metres: less ends the ICP
_SAMPLE = 3  # correspondences that give a pose
_GRAZING = 0.1  # cosine to the viewing direction below which a surface is not measured
_MOST_NEIGHBOURS = 100  # of a feature
_SEED = 0


class FpfhDetector:
    """Finds every instance of one part by fast point feature histograms; the part's own are computed when made.

    Args:
        part: what to look for; its symmetry says which poses are the same.
        settings: of the search.
        threads: of Open3D.

    Raises:
        ValueError: when Open3D is missing.
    """

    def __init__(self, part: Part, settings: FpfhSettings | None = None, threads: int = 1) -> None:
        self.part, self.settings, self.threads = part, settings or FpfhSettings(), threads
        self._open3d: ModuleType = registration()
        low, high = part.vertices.min(axis=0), part.vertices.max(axis=0)
        self._center = (low + high) / 2
        self._reach = float(np.linalg.norm(part.vertices - self._center, axis=1).max())
        rng = np.random.default_rng(_SEED)
        self._surface = surface(part, _FIT_POINTS, rng)
        self._model = thinned(surface(part, _MODEL_POINTS, rng), self.settings.sampling * part.diameter)
        self._rows, features = self._features_as_seen()
        self._tree = cKDTree(features)

    def detect(self, points: NDArray[np.floating], normals: NDArray[np.floating] | None) -> Detections:
        """Every instance in a cloud, best score first; none when the cloud is too small to tell.

        Args:
            points: ``(P, 3)`` metres, camera frame, parts only (as the network's input).
            normals: ``(P, 3)`` unit vectors towards the camera (``geometry.pointcloud.estimate_normals``).

        Raises:
            ValueError: when normals are missing, shapes disagree or a number is not finite.
        """
        cloud = checked(points, normals, "fast point feature histograms")
        settings, diameter = self.settings, self.part.diameter
        scene = thinned(cloud, settings.sampling * diameter) if len(cloud) >= _LEAST_POINTS else cloud
        if len(scene) < _LEAST_POINTS:
            return Detections(np.zeros((0, 4, 4)), np.zeros(0))
        measured = cKDTree(cloud[:, :3])
        with threads(self._open3d, self.threads):
            poses = self.registered(scene)
            rough = fits(poses, self._surface[::_RANKING_STEP], measured, settings.sampling * diameter)
            # The fits of similar poses add up: what was found from several references comes first.
            poses, _ = merged(
                poses,
                rough,
                self._center,
                self.part.symmetry,
                settings.merge_distance * diameter,
                math.radians(settings.merge_degrees),
            )
            poses = self.refined(poses[: settings.hypotheses], cloud)
        scores = fits(poses, self._surface, measured, settings.fit_distance * diameter)
        separate = apart(poses, scores, self._center, settings.separation * diameter)
        return Detections(poses[separate], scores[separate])

    def registered(self, scene: NDArray[np.float32]) -> Array:
        """A pose ``(R, 4, 4)`` around every reference of a thinned scene ``(P, 6)``, wrong ones among them."""
        settings, diameter = self.settings, self.part.diameter
        pipeline = self._open3d.pipelines.registration
        distance = settings.inlier_distance * diameter
        checks = [
            pipeline.CorrespondenceCheckerBasedOnEdgeLength(settings.edge_similarity),
            pipeline.CorrespondenceCheckerBasedOnDistance(distance),
            pipeline.CorrespondenceCheckerBasedOnNormal(math.radians(settings.normal_degrees)),
        ]
        # Confidence 1 is never reached: no early exit.
        criteria = pipeline.RANSACConvergenceCriteria(settings.iterations, 1.0)
        estimate = pipeline.TransformationEstimationPointToPoint(False)
        nearest = self._tree.query(self._features(scene), k=settings.matches)[1].reshape(len(scene), -1)
        matches = self._rows[nearest]  # (P, matches) points of the model
        model, tree = point_cloud(self._open3d, self._model), cKDTree(scene[:, :3])
        found = []
        for center in scene[:: settings.reference_step, :3]:
            near = np.sort(tree.query_ball_point(center, settings.neighborhood * diameter))
            if len(near) < _LEAST_NEAR:
                continue
            pairs = np.stack([np.repeat(np.arange(len(near)), settings.matches), matches[near].ravel()], axis=1)
            self._open3d.utility.random.seed(_SEED)
            result = pipeline.registration_ransac_based_on_correspondence(
                point_cloud(self._open3d, scene[near]),
                model,
                self._open3d.utility.Vector2iVector(pairs.astype(np.int32)),
                distance,
                estimate,
                _SAMPLE,
                checks,
                criteria,
            )
            part_from_camera = np.array(result.transformation, dtype=np.float64)
            if result.fitness > 0 and np.isfinite(part_from_camera).all():
                found.append(inverse(part_from_camera))
        return np.array(found, dtype=np.float64).reshape(-1, 4, 4)

    def refined(self, poses: Array, cloud: NDArray[np.float32]) -> Array:
        """Poses ``(R, 4, 4)`` after point-to-plane ICP against a cloud ``(P, 6)``; one that it cannot move stays."""
        settings, pipeline = self.settings, self._open3d.pipelines.registration
        estimate = pipeline.TransformationEstimationPointToPlane()
        criteria = pipeline.ICPConvergenceCriteria(_ICP_CHANGE, _ICP_CHANGE, settings.icp_iterations)
        cloud = cloud[:: math.ceil(len(cloud) / settings.icp_points)]
        tree = cKDTree(cloud[:, :3])
        moved = poses.copy()
        for i, pose in enumerate(poses):
            near = np.sort(tree.query_ball_point(pose[:3, :3] @ self._center + pose[:3, 3], 1.2 * self._reach))
            if len(near) < _LEAST_POINTS:
                continue
            target = point_cloud(self._open3d, cloud[near])
            for share in (settings.icp_distance, settings.icp_distance / 3):
                model = placed(self._surface, moved[i])  # another pose shows other points
                if len(model) < _LEAST_POINTS:
                    break
                step = pipeline.registration_icp(
                    point_cloud(self._open3d, model), target, share * self.part.diameter, np.eye(4), estimate, criteria
                ).transformation
                if np.isfinite(step).all():
                    moved[i] = np.asarray(step, dtype=np.float64) @ moved[i]
        return moved

    def _features_as_seen(self) -> tuple[NDArray[np.int64], Array]:
        """Rows ``(F,)`` of the model and their features ``(F, 33)``, a row once for every direction that it faces."""
        rows, features = [], []
        with threads(self._open3d, self.threads):
            for direction in _directions(self.settings.views):
                facing = np.flatnonzero(self._model[:, 3:] @ direction > _GRAZING)
                if len(facing):
                    rows.append(facing)
                    features.append(self._features(self._model[facing]))
        return np.concatenate(rows), np.concatenate(features)

    def _features(self, cloud: NDArray[np.float32]) -> Array:
        """Open3D's histograms ``(P, 33)`` of a thinned cloud ``(P, 6)``."""
        search = self._open3d.geometry.KDTreeSearchParamHybrid(
            radius=self.settings.feature_radius * self.part.diameter, max_nn=_MOST_NEIGHBOURS
        )
        computed: Any = self._open3d.pipelines.registration.compute_fpfh_feature(
            point_cloud(self._open3d, cloud), search
        )
        return np.ascontiguousarray(np.asarray(computed.data, dtype=np.float64).T)


def _directions(count: int) -> Array:
    """Unit vectors ``(count, 3)`` spread evenly over the sphere (a Fibonacci lattice)."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = math.pi * (1 + math.sqrt(5)) * index
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
