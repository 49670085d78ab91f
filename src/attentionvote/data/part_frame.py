"""Check that mesh and poses are in one frame: the points of a dataset's parts must lie on the part's surface."""

from __future__ import annotations

import numpy as np

from attentionvote.data.nearest_surface import PartSurface
from attentionvote.part import Part
from attentionvote.scene import BACKGROUND, Scene

_TOLERANCE = 0.03  # of D: nine of ten points of an instance must lie so near to the part's surface at its pose
_INSTANCES = 3  # that are looked at, the most visible ones
_LEAST_OWNED = 0.8  # of the points of a scene without background whose instances were told by the surface


def check_part_frame(scene: Scene, part: Part, where: str, labelled: bool) -> None:
    """Refuse a part whose surface is not where the points are.

    Args:
        scene: of the dataset; with labels, those of the files.
        part: that should be in it.
        where: the dataset's folder.
        labelled: whether ``instance_ids`` come from labels; else from ``PartSurface.owners``.

    Raises:
        ValueError: with one sentence: mesh and poses are in different frames or units.
    """
    remedy = "use the dataset's own mesh, in metres and not moved"
    if not labelled:
        owned = float(np.mean(scene.instance_ids != BACKGROUND)) if len(scene.points) else 1.0
        if owned < _LEAST_OWNED:
            raise ValueError(
                f"{part.name} must have the frame of the poses in {where} ({100 * _LEAST_OWNED:.0f} % of a scene's "
                f"points on the posed surfaces at least), got {100 * owned:.0f} %: {remedy}"
            )
        return
    surface = PartSurface(part)
    distances = [
        surface.distances(scene.points[scene.instance_ids == instance], scene.camera_from_part[instance])
        for instance in np.argsort(-scene.visible_fraction)[:_INSTANCES]
    ]
    point_distances = np.concatenate(distances)
    apart, limit = float(np.quantile(point_distances, 0.9)) if len(point_distances) else 0.0, _TOLERANCE * part.diameter
    if apart > limit:
        raise ValueError(
            f"{part.name} must have the frame of the poses in {where} (points within {1000 * limit:.1f} mm of its "
            f"surface), got {1000 * apart:.1f} mm: {remedy}"
        )
