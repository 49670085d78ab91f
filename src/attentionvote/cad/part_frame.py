"""The frame in which a part's symmetry is stated: the file's own, or the principal one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from attentionvote.cad.symmetry_search import quaternions_of
from attentionvote.geometry import pose
from attentionvote.geometry.symmetry import Axis, Symmetry

Array = NDArray[np.float64]

ORIGIN_OFFSET = 1e-4  # of the diameter: an axis this near passes through the file's origin
SNAP_ANGLE = np.radians(0.05)  # an axis this near a coordinate axis is that axis


def axis_of(u: Array) -> Axis:
    """The axis as a tuple, its largest component positive."""
    v = np.round(u * np.sign(u[np.argmax(np.abs(u))]), 12) + 0.0
    return float(v[0]), float(v[1]), float(v[2])


def nearest_fixed_point(symmetry: Symmetry, centroid: Array) -> Array:
    """The file's origin, shifted along the axis of a group that has only one (which changes nothing)."""
    if symmetry.kind == "cyclic" or (symmetry.kind == "revolution" and not symmetry.flip):
        return np.asarray(np.dot(centroid, symmetry.axis) * np.asarray(symmetry.axis))
    return centroid if symmetry.kind == "none" else np.zeros(3)


def principal_frame(symmetry: Symmetry, vertices: Array, centroid: Array, covariance: Array, diameter: float) -> Array:
    """Identity when the file's frame serves, else the principal frame about the surface centroid."""
    low, high = vertices.min(0), vertices.max(0)
    is_inside = bool(((low <= 0) & (high >= 0)).all())
    offset = float(np.linalg.norm(centroid - nearest_fixed_point(symmetry, centroid)))
    if is_inside and offset <= ORIGIN_OFFSET * diameter:
        return np.eye(4)
    long_axes = np.linalg.eigh(covariance)[1].T[::-1]
    z = np.asarray(axis_of(long_axes[0])) if symmetry.kind in ("none", "group") else np.asarray(symmetry.axis)
    if symmetry.kind == "group":
        file_from_part = np.eye(3)
    else:
        x = np.asarray(symmetry.flip_axis) if symmetry.kind == "dihedral" else _first_across(z, long_axes)
        file_from_part = np.stack([x, np.cross(z, x), z], axis=-1)
    if np.abs(file_from_part - np.round(file_from_part)).max() < SNAP_ANGLE:
        file_from_part = np.round(file_from_part)
    return pose.transform(file_from_part.T, -file_from_part.T @ centroid)


def _first_across(z: Array, axes: Array) -> Array:
    """The first of ``axes`` that is not z, made perpendicular to it."""
    x = next(u for u in axes if abs(u @ z) < 0.9)
    x = np.asarray(axis_of(x - (x @ z) * z))
    return x / np.linalg.norm(x)


def turned(symmetry: Symmetry, rotation: Array) -> Symmetry:
    """``symmetry`` in the frame reached by ``rotation``; unchanged for the identity."""
    if np.array_equal(rotation, np.eye(3)) or symmetry.kind == "none":
        return symmetry
    if symmetry.kind == "group":
        elements = rotation @ symmetry.rotations() @ rotation.T
        return Symmetry("group", quaternions=quaternions_of(elements))
    axis, flip_axis = (axis_of(np.round(rotation @ np.asarray(u), 12)) for u in (symmetry.axis, symmetry.flip_axis))
    return Symmetry(symmetry.kind, axis, symmetry.order, symmetry.flip, flip_axis)
