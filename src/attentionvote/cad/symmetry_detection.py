"""Detects the proper symmetry of a part, and verifies it against the surface.

A symmetry leaves the surface centroid in place and commutes with the surface covariance, so the principal
frame names nearly all candidates: three half turns where the principal moments differ, turns of any order
about the single axis where two are equal, a search over all directions where all three are. What counts is
only the check: every rotation of the group, applied to the surface, must leave it within ``tolerance`` of itself
everywhere, measured from dense points and corners to the exact surface, both ways. The tolerance is tight (0.03 % of
the diameter by default), because a symmetry that is none teaches the network that two different poses are one.

Curves of a CAD part come as facets, and what the facets' own height explains is no difference
(``tessellation.facet_heights``): a cylinder of 16 facets is a body of revolution, a hexagon and a gear of 24 teeth are
not. What a sensor could not see beyond that, a thread or an engraved mark, is reported (``hidden_symmetry``) and is the
user's to decide.

The part frame is the file's own wherever possible: the axis must pass through the file's origin (all axes,
if there are several) and the origin must lie inside the bounding box. Otherwise the part is moved: origin
at the surface centroid (it is on every axis), z along the symmetry axis (the longest principal axis without
one), x along the next principal axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attentionvote.cad.mesh_file import largest_vertex_distance
from attentionvote.cad.part_frame import SNAP_ANGLE, axis_of, nearest_fixed_point, principal_frame, turned
from attentionvote.cad.rotation_check import RotationCheck
from attentionvote.cad.symmetry_groups import describe, generators, group_size, tested_rotations
from attentionvote.cad.symmetry_search import closure, quaternions_of, refine_axis, search_axes, turns_about
from attentionvote.geometry import pose
from attentionvote.geometry.symmetry import Axis, Symmetry
from attentionvote.part import surface_moments

Array = NDArray[np.float64]

TOLERANCE = 0.0003  # of the diameter
UNSEEN = 0.003  # of the diameter: what a sensor hardly sees of a part that fills its picture
THIN = 0.1  # of the part's thickness: a sheet is not turned over within a tolerance of its own thickness
EQUAL_MOMENTS = 0.04  # relative difference of principal radii below which they may be equal
LARGEST_ORDER = 180
MOST_ORDERS = 12  # that are looked at closely; divisors of the right one fit as well as it does


@dataclass(frozen=True)
class SymmetryFinding:
    """What was found.

    ``symmetry`` is in the part frame; ``part_from_file`` ``(4, 4)`` is the identity unless ``moved``.
    ``residual`` (largest distance of a turned surface to itself over the whole group, beyond the height of its
    facets), ``facet_height`` (of the coarsest curve), ``diameter``, ``tolerance`` and ``runner_up_residual`` (of the
    best hypothesis that was rejected: a lower bound, its axis in the file's frame) are metres. ``searched``: the
    surface's moments name no axis, so that all directions were searched.
    """

    symmetry: Symmetry
    part_from_file: Array
    moved: bool
    residual: float
    tolerance: float
    runner_up: str
    runner_up_residual: float
    facet_height: float
    diameter: float
    searched: bool


def detect_symmetry(vertices: Array, faces: NDArray[np.int64], tolerance: float = TOLERANCE) -> SymmetryFinding:
    """Find and verify the proper symmetry group of a surface and the part frame it is stated in.

    Args:
        vertices: ``(V, 3)`` metres, any frame.
        faces: ``(F, 3)`` closed surface.
        tolerance: largest distance between surface and turned surface, as a fraction of the largest
            vertex distance; at most a tenth of the part's thickness counts.

    Raises:
        ValueError: on an impossible tolerance, or a ball (it has no orientation to estimate).
    """
    if not 0 < tolerance <= 0.05:
        raise ValueError(f"symmetry tolerance must be above 0 and at most 0.05 of the diameter, got {tolerance}")
    diameter = largest_vertex_distance(vertices)
    _, centroid, covariance = surface_moments(vertices, faces)
    across = (vertices - centroid) @ np.linalg.eigh(covariance)[1]
    limit = min(tolerance * diameter, THIN * float(np.ptp(across, axis=0).min()))
    check = RotationCheck(vertices - centroid, faces, limit)
    detection = _Detection(check, covariance)
    symmetry = _tidy(detection.group())
    centre = centroid + check.centre(generators(symmetry)) if symmetry.kind != "none" else centroid
    part_from_file = principal_frame(symmetry, vertices, centre, covariance, diameter)
    moved = not np.array_equal(part_from_file, np.eye(4))
    # The last word: the symmetry exactly as it will be written, about the origin that it will be written for.
    fixed_point = (centre if moved else nearest_fixed_point(symmetry, centre)) - centroid
    residual = max((check.residual(r, centre=fixed_point) for r in tested_rotations(symmetry)), default=0.0)
    runner_up, runner_up_residual = detection.runner_up()
    return SymmetryFinding(
        symmetry=turned(symmetry, part_from_file[:3, :3]),
        part_from_file=part_from_file,
        moved=moved,
        residual=residual,
        tolerance=limit,
        runner_up=runner_up,
        runner_up_residual=runner_up_residual,
        facet_height=check.facet_height,
        diameter=diameter,
        searched=detection.searched,
    )


def hidden_symmetry(vertices: Array, faces: NDArray[np.int64], finding: SymmetryFinding) -> SymmetryFinding | None:
    """The larger group that the part has when differences below ``UNSEEN`` of its diameter are overlooked, if any.

    Args:
        vertices: ``(V, 3)`` metres, in the file's frame.
        faces: ``(F, 3)`` closed surface.
        finding: what the part has without overlooking anything.

    Raises:
        ValueError: as ``detect_symmetry``.
    """
    if finding.tolerance >= UNSEEN * finding.diameter:
        return None
    # Where the axes are known, what was rejected failed by no less than the runner-up did.
    if finding.runner_up_residual > UNSEEN * finding.diameter and not finding.searched:
        return None
    larger = detect_symmetry(vertices, faces, UNSEEN)
    return larger if group_size(larger.symmetry) > group_size(finding.symmetry) else None


class _Detection:
    """Hypotheses in order of size; the rejected ones are remembered for the runner-up."""

    def __init__(self, check: RotationCheck, covariance: Array) -> None:
        self.check = check
        values, vectors = np.linalg.eigh(covariance)
        self.radii = np.sqrt(np.clip(values, 0, None))  # ascending
        self.axes = vectors.T
        self.rejected: list[tuple[float, str]] = []
        self.searched = bool((np.diff(self.radii) < EQUAL_MOMENTS * self.radii[1:]).all())

    def group(self) -> Symmetry:
        near = np.diff(self.radii) < EQUAL_MOMENTS * self.radii[1:]
        if self.searched:
            return self._any_direction()
        if near[0]:
            return self._single_axis(self.axes[2], self.axes[0])
        if near[1]:
            return self._single_axis(self.axes[0], self.axes[2])
        return self._half_turns()

    def runner_up(self) -> tuple[str, float]:
        if not self.rejected:
            return "nothing else was near", float("inf")
        residual, name = min(self.rejected)
        return name, residual

    def _accept(self, symmetry: Symmetry) -> bool:
        """Whether the whole group leaves the surface in place."""
        rotations = tested_rotations(symmetry)
        centre = self.check.centre(generators(symmetry))
        if self.check.holds(rotations, centre):
            return True
        if symmetry.order <= 12:  # larger ones turn so little that their residual says nothing
            self.rejected.append((self.check.worst(rotations, centre), describe(symmetry)))
        return False

    def _refined(self, axis: Array, order: int = 2) -> Array:
        """The axis near ``axis`` whose turns fit best; the principal axes of a tessellated surface are a little off."""
        return refine_axis(self.check, axis, 2 * np.pi / order * (order // 2)) if self.check.facet_height else axis

    def _half_turns(self) -> Symmetry:
        """Three different principal moments: nothing but half turns about the principal axes."""
        turns = [Symmetry("cyclic", axis_of(self._refined(u)), 2) for u in self.axes[::-1]]
        accepted = [s for s in turns if self._accept(s)]
        if len(accepted) >= 2:
            both = Symmetry("dihedral", accepted[0].axis, 2, flip_axis=_across(accepted[0].axis, accepted[1].axis))
            if self._accept(both):
                return both
        return accepted[0] if accepted else Symmetry()

    def _single_axis(self, axis: Array, other: Array) -> Symmetry:
        """Two equal principal moments: turns about ``axis``, half turns about axes across it."""
        revolution = Symmetry("revolution", axis_of(self._refined(axis)))
        if self._accept(revolution):
            flipped = Symmetry("revolution", revolution.axis, flip=True)
            return flipped if self._accept(flipped) else revolution
        order, axis = self._order(axis)
        across = self._across(axis, other, order)
        if across is None:
            return Symmetry("cyclic", axis_of(axis), order) if order > 1 else Symmetry()
        if order == 1:
            return Symmetry("cyclic", axis_of(across), 2)
        dihedral = Symmetry("dihedral", axis_of(axis), order, flip_axis=axis_of(across))
        return dihedral if self._accept(dihedral) else Symmetry("cyclic", axis_of(axis), order)

    def _order(self, axis: Array) -> tuple[int, Array]:
        """The largest order of a cyclic group about ``axis``, and the axis; all its turns are checked, not one."""
        orders = np.arange(2, LARGEST_ORDER + 1)
        turns = (pose.rotation_about(axis, 2 * np.pi / order * np.arange(1, order)) for order in orders)
        off = np.array([self.check.roughly(rotations) for rotations in turns])
        for order in range(2, 13):  # larger ones turn so little that their residual says nothing
            if off[order - 2] > self.check.tolerance + self.check.facet_height:
                self.rejected.append((float(off[order - 2]), describe(Symmetry("cyclic", axis_of(axis), order))))
        # The axis is not refined yet: what is nearest counts, and of these the largest.
        slack = off.min() + self.check.tolerance + self.check.facet_height / 4
        nearest = orders[off <= slack][np.argsort(off[off <= slack], kind="stable")][:MOST_ORDERS]
        for order in sorted({*nearest.tolist(), *orders[:11][off[:11] <= slack].tolist()}, reverse=True):
            refined = self._refined(axis, order)
            if self._accept(Symmetry("cyclic", axis_of(refined), order)):
                return order, refined
        return 1, axis

    def _across(self, axis: Array, other: Array, order: int) -> Array | None:
        """An axis perpendicular to ``axis`` whose half turn holds; they repeat every half turn / ``order``."""
        period = np.pi / order
        count = max(16, int(np.ceil(period / np.radians(1.0))))
        angles = np.arange(count) * period / count
        axes = pose.rotation_about(axis, angles) @ other
        scores = self.check.means(turns_about(axes, np.pi))
        minima = np.flatnonzero((scores <= np.roll(scores, 1)) & (scores <= np.roll(scores, -1)))
        for i in minima[np.argsort(scores[minima])][:8]:
            across = refine_axis(self.check, axes[i], np.pi)
            if order > 1:  # two axes of one group are perpendicular: take the rounding out
                across = across - (across @ axis) * axis
                across /= np.linalg.norm(across)
            if self._accept(Symmetry("cyclic", axis_of(across), 2)):
                return across
        return None

    def _any_direction(self) -> Symmetry:
        """Three equal principal moments: a regular polyhedron's group, or an accident of proportions."""
        axes = search_axes(self.check)
        found = self._of_axes(axes)
        if found.is_revolution or found.kind == "group":
            return found
        # Only small orders were searched: a gear of 17 teeth as wide as high shows its half turns, or nothing.
        turned_over = [u for u, n in axes if n == 2][:2]
        across = [np.cross(turned_over[0], turned_over[1])] if len(turned_over) == 2 else []
        for axis in [*across, *self.axes]:
            unit = axis / np.linalg.norm(axis)
            other = self._single_axis(unit, np.asarray(Symmetry("none", axis_of(unit)).perpendicular))
            found = max(found, other, key=group_size)
        return found

    def _of_axes(self, axes: list[tuple[Array, int]]) -> Symmetry:
        """The group that the axes and prime orders found make, or that they are part of."""
        revolutions: list[Array] = []
        for u, _ in axes:
            is_new = all(abs(u @ v) < np.cos(0.1) for v in revolutions)
            if is_new and self.check.holds(tested_rotations(Symmetry("revolution", axis_of(u)))):
                revolutions.append(u)
        if len(revolutions) > 1:
            raise ValueError("the part must not be a ball, which looks the same from all sides: it has no orientation")
        if revolutions:
            return self._single_axis(
                revolutions[0], np.asarray(Symmetry("none", axis_of(revolutions[0])).perpendicular)
            )
        if not axes:
            return Symmetry()
        group = closure(np.stack([pose.rotation_about(u, 2 * np.pi / n) for u, n in axes]))
        # A group about one axis has at most half turns across it; a polyhedron's has several axes of order >= 3.
        many = [u for u, n in axes if n > 2]
        has_single_axis = all(abs(u @ many[0]) > np.cos(0.1) for u in many)
        if group is not None and not has_single_axis:
            symmetry = Symmetry("group", quaternions=quaternions_of(group))
            if self._accept(symmetry):
                return symmetry
        axis = max(axes, key=lambda item: (item[1], sum(abs(item[0] @ u) < 0.05 for u, _ in axes)))[0]
        return self._single_axis(axis, np.asarray(Symmetry("none", axis_of(axis)).perpendicular))


def _across(axis: Axis, other: Axis) -> Axis:
    """``other`` made exactly perpendicular to ``axis``."""
    u = np.asarray(other) - np.dot(other, axis) * np.asarray(axis)
    return axis_of(u / np.linalg.norm(u))


def _tidy(symmetry: Symmetry) -> Symmetry:
    """Axes within 0.05 degrees of a coordinate axis become that axis."""

    def snapped(axis: Axis) -> Axis:
        u = np.asarray(axis)
        unit = np.eye(3)[np.argmax(np.abs(u))]
        return axis_of(unit) if np.linalg.norm(u - unit) < SNAP_ANGLE else axis

    if symmetry.kind == "group":
        return symmetry
    axis, flip_axis = snapped(symmetry.axis), snapped(symmetry.flip_axis)
    if symmetry.kind == "dihedral":
        flip_axis = snapped(_across(axis, flip_axis))
    return Symmetry(symmetry.kind, axis, symmetry.order, symmetry.flip, flip_axis)
