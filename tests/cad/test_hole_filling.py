"""Lids: where a surface can be told from what is around it, and where it cannot."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from trimesh.creation import box, cylinder, icosphere

from attentionvote.cad.face_topology import paired
from attentionvote.cad.hole_filling import EXACT_CORNERS, LARGEST_MOVE, Lids, lids


def lids_of(mesh: trimesh.Trimesh, gone: NDArray[np.bool_]) -> tuple[Lids, trimesh.Trimesh]:
    """Lids for a mesh without some of its faces, and the mesh with them; in shares of its diameter."""
    vertices = np.asarray(mesh.vertices) / np.linalg.norm(mesh.extents)
    faces, mate = paired(vertices, np.asarray(mesh.faces)[~gone])
    result = lids(vertices, faces, mate)
    return result, trimesh.Trimesh(vertices, np.concatenate([faces, result.faces]), process=False)


def first(mesh: trimesh.Trimesh, *faces: int) -> NDArray[np.bool_]:
    return np.isin(np.arange(len(mesh.faces)), faces)


def volume_of(mesh: trimesh.Trimesh) -> float:
    return float(mesh.volume / np.linalg.norm(mesh.extents) ** 3)


@pytest.mark.parametrize("mesh", [box(), cylinder(1, 3, sections=12), icosphere(2)], ids=["box", "cylinder", "ball"])
def test_a_missing_triangle_is_put_back(mesh: trimesh.Trimesh) -> None:
    for face in range(0, len(mesh.faces), 5):
        result, closed = lids_of(mesh, first(mesh, face))
        assert (result.holes, len(result.faces), result.uncertainty, len(result.refused)) == (1, 1, 0.0, 0)
        assert closed.is_watertight
        assert closed.volume == pytest.approx(volume_of(mesh))


def test_two_holes_that_meet_in_a_vertex_are_two() -> None:
    mesh = icosphere(2)
    around = np.flatnonzero((mesh.faces == 0).any(axis=1))
    shared = [int((np.isin(mesh.faces[f], mesh.faces[around[0]])).sum()) for f in around]
    across = int(around[shared.index(1)])
    result, closed = lids_of(mesh, first(mesh, int(around[0]), across))
    assert (result.holes, len(result.faces)) == (2, 2)
    assert closed.volume == pytest.approx(volume_of(mesh))


@pytest.mark.parametrize(("subdivisions", "is_exact"), [(2, True), (5, False)])
def test_a_flat_hole_in_a_face_is_closed_flat_however_wide(subdivisions: int, is_exact: bool) -> None:
    plate = box([10, 10, 1])
    for _ in range(subdivisions):
        plate = plate.subdivide()
    gone = (plate.face_normals[:, 2] > 0.9) & (np.abs(plate.triangles_center[:, :2]).max(axis=1) < 2.6)
    result, closed = lids_of(plate, gone)
    assert result.holes == 1
    assert (len(result.faces) + 2 <= EXACT_CORNERS) == is_exact
    assert closed.is_watertight
    assert closed.volume == pytest.approx(volume_of(plate))
    assert closed.area == pytest.approx(plate.area / np.linalg.norm(plate.extents) ** 2)


def test_the_end_of_a_tube_and_a_crooked_hole_are_refused() -> None:
    tube = cylinder(1, 3, sections=24)
    result, _ = lids_of(tube, tube.face_normals[:, 2] > 0.5)
    assert (result.holes, len(result.refused)) == (0, 24)
    ball = icosphere(2)
    result, _ = lids_of(ball, (ball.faces == 0).any(axis=1) | (ball.faces == ball.faces[0][1]).any(axis=1))
    assert result.holes == 0
    assert len(result.refused) > 6


def test_how_far_from_flat_the_rim_is_bounds_what_is_invented() -> None:
    # A square hole of one small cell, one corner lifted: half of it is the uncertainty.
    for lift, is_closed in ((0.6 * LARGEST_MOVE, True), (6 * LARGEST_MOVE, False)):
        plate = box([10, 10, 1]).subdivide().subdivide().subdivide()
        top = np.flatnonzero(plate.face_normals[:, 2] > 0.9)
        near = top[np.argsort(np.linalg.norm(plate.triangles_center[top, :2] - [0.7, 0.3], axis=1))[0]]
        i = plate.face_adjacency[(plate.face_adjacency == near).any(axis=1)]
        flat = [p for p in i if np.isin(p, top).all()]
        gone = first(plate, *(int(f) for f in flat[0]))
        rim = np.unique(plate.faces[gone])
        vertices = np.asarray(plate.vertices).copy()
        vertices[rim[0], 2] += lift * np.linalg.norm(plate.extents)
        bent = trimesh.Trimesh(vertices, plate.faces, process=False)
        result, _ = lids_of(bent, gone)
        assert (result.holes == 1) == is_closed
        if is_closed:
            assert 0.1 * lift < result.uncertainty <= 0.5 * lift


def test_the_ends_of_a_bore_whose_wall_is_missing_are_not_closed() -> None:
    plate = trimesh.boolean.difference([box([10, 6, 1]), cylinder(0.3, 4, sections=24)])
    radius = np.linalg.norm(plate.triangles_center[:, :2], axis=1)
    is_wall = (np.abs(plate.face_normals[:, 2]) < 0.5) & (radius < 0.4)
    assert is_wall.sum() == 48
    result, _ = lids_of(plate, is_wall)
    assert (result.holes, len(result.refused)) == (0, 48)


def test_a_missing_ring_is_not_closed_by_two_discs() -> None:
    # The floor of a counterbore: the through bore would become blind under a membrane.
    bores = [cylinder(0.3, 4, sections=24), cylinder(0.45, 1, sections=24)]
    bores[1].apply_translation([0, 0, 0.7])
    plate = trimesh.boolean.difference([box([10, 6, 1]), *bores])
    heights = plate.triangles_center[:, 2]
    is_floor = (np.abs(plate.face_normals[:, 2]) > 0.9) & (np.abs(heights - 0.2) < 0.01)
    assert is_floor.any()
    result, _ = lids_of(plate, is_floor)
    assert (result.holes, len(result.refused)) == (0, 48)
