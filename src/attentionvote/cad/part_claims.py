"""What an object's file claims of its part, size and symmetry, against the mesh it names."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from attentionvote.cad.mesh_file import largest_vertex_distance
from attentionvote.cad.symmetry_detection import detect_symmetry
from attentionvote.cad.symmetry_groups import describe, tested_rotations
from attentionvote.geometry.pose import apply, transform
from attentionvote.part import Part, surface_moments

Array = NDArray[np.float64]

# Benchmarks define the diameter as the largest vertex distance, that of some sphere around, or the box's diagonal.
SIZES = (0.6, 1.75)
CONTRADICTION = 0.05  # of D, that a claimed symmetry may carry the surface off itself: no tolerance goes further
SAME_SHAPE = 0.003  # of D: two surfaces this near are one to any sensor
LARGEST_RATIO = 8.0  # of the diameters in one bin: lengths of the network are shares of the largest
SURFACE_POINTS, TEST_POINTS = 40_000, 300
MOST_ROTATIONS = 400  # that are tried of a large group


def check_claims(part: Part) -> None:
    """Refuse a diameter or a symmetry that the part's own surface contradicts.

    Raises:
        ValueError: with the figure, and the right value.
    """
    size = largest_vertex_distance(part.vertices)
    low, high = SIZES
    if not low * size <= part.diameter <= high * size:
        raise ValueError(
            f"{part.name}: diameter must be the size of its mesh, in metres, got {part.diameter:.6g} for a surface of "
            f"{size:.6g} from end to end; diameter: {size:.6g} is right"
        )
    if part.symmetry.kind == "none":
        return
    off = _carried_off(part)
    if off > CONTRADICTION * part.diameter:
        right = detect_symmetry(part.vertices, part.faces)
        shape = "has none" if right.symmetry.kind == "none" else f"is {describe(right.symmetry)}"
        where = " about another origin" if right.moved else ""
        raise ValueError(
            f"{part.name}: symmetry must leave the surface in place, but {describe(part.symmetry)} carries it "
            f"{off * 1e3:.3g} mm ({off / part.diameter:.0%} of D) off itself; that of the mesh {shape}{where} "
            "(`make part` finds it)"
        )


def check_set(name: str, parts: Sequence[Part]) -> None:
    """Refuse parts that no sensor can tell apart, or that are too different in size for one network.

    Raises:
        ValueError: naming both, with the figure.
    """
    for i, part in enumerate(parts):
        for other in parts[:i]:
            small, large = sorted((part, other), key=lambda p: p.diameter)
            if large.diameter > LARGEST_RATIO * small.diameter:
                raise ValueError(
                    f"{name}: the parts of a set must be of like size, the largest at most {LARGEST_RATIO:g} times the "
                    f"smallest, got {large.name} of {large.diameter * 1e3:.4g} mm and {small.name} of "
                    f"{small.diameter * 1e3:.4g} mm: train them apart"
                )
            apart = _difference(part, other)
            if apart <= SAME_SHAPE * large.diameter:
                raise ValueError(
                    f"{name}: the parts of a set must differ in shape, but {other.name} and {part.name} are one "
                    f"surface to {apart * 1e3:.3g} mm, in one frame or two: leave one of them out"
                )


def _carried_off(part: Part) -> float:
    """Largest distance in metres that the part's symmetry carries the farthest of its points off its surface, to within
    the spacing of ``SURFACE_POINTS``."""
    rng = np.random.default_rng(0)
    surface = cKDTree(np.concatenate([part.surface_points(SURFACE_POINTS, rng), part.vertices]))
    corners = part.vertices[np.unique(part.faces)]
    points = np.concatenate([part.surface_points(TEST_POINTS, rng), rng.permutation(corners)[:TEST_POINTS]])
    rotations = tested_rotations(part.symmetry)
    rotations = rotations[:: max(1, len(rotations) // MOST_ROTATIONS)]
    turned = np.einsum("rij,pj->rpi", rotations, points)
    return float(surface.query(turned.reshape(-1, 3))[0].max())


def _difference(part: Part, other: Part) -> float:
    """Distance in metres within which 95 % of one surface lies of the other, in the best of the frames that their
    moments allow; inf where the moments differ."""
    moments = [surface_moments(p.vertices, p.faces) for p in (part, other)]
    areas = np.array([area for area, _, _ in moments])
    frames = [np.linalg.eigh(covariance) for _, _, covariance in moments]
    radii = np.array([np.sqrt(np.clip(values, 0, None)) for values, _ in frames])
    limit = 2 * SAME_SHAPE * max(part.diameter, other.diameter)
    if np.abs(radii[0] - radii[1]).max() > limit or np.ptp(areas) > 0.05 * areas.max():
        return float("inf")
    rng = np.random.default_rng(0)
    surface = cKDTree(other.surface_points(SURFACE_POINTS, rng))
    spacing = float(np.sqrt(areas[1] / SURFACE_POINTS))
    points = part.surface_points(TEST_POINTS, rng)
    best = np.inf
    for signs in np.array([[x, y, z] for x in (1, -1) for y in (1, -1) for z in (1, -1)], dtype=float):
        rotation = (frames[1][1] * signs) @ frames[0][1].T
        if np.linalg.det(rotation) < 0:  # a mirror image is another part
            continue
        moved = apply(transform(rotation, moments[1][1] - rotation @ moments[0][1]), points)
        best = min(best, float(np.quantile(surface.query(moved)[0], 0.95)))
    return max(0.0, best - spacing)
