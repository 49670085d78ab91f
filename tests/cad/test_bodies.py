"""Shells, solids and bodies: cavities, solids in solids, what touches and what stands apart."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from trimesh.creation import box, icosphere

from attentionvote.cad.bodies import body_of, gap, inside, solids_of, united

Scene = tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]


def shells(*meshes: trimesh.Trimesh) -> Scene:
    joined = trimesh.util.concatenate(meshes)
    label = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    return np.asarray(joined.vertices, dtype=np.float64), np.asarray(joined.faces, dtype=np.int64), label


def moved(x: float) -> NDArray[np.float64]:
    return trimesh.transformations.translation_matrix([x, 0, 0])


def inverted(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh.invert()
    return mesh


def test_a_shell_turned_inward_is_a_cavity_whichever_way_the_file_is_turned() -> None:
    for outer, inner in ((box(), inverted(icosphere(1, 0.3))), (inverted(box()), icosphere(1, 0.3))):
        vertices, faces, label = shells(outer, inner)
        solids = solids_of(vertices, faces, label)
        assert (solids.solid == 0).all()
        assert solids.cavities == 1
        assert solids.turned == (0 if outer.volume > 0 else 2)
        volume = trimesh.Trimesh(vertices, solids.faces, process=False).volume
        assert volume == pytest.approx(1 - icosphere(1, 0.3).volume)


def test_shells_turned_alike_are_a_solid_in_a_solid() -> None:
    vertices, faces, label = shells(box(), icosphere(1, 0.3))
    solids = solids_of(vertices, faces, label)
    assert np.unique(solids.solid).tolist() == [0, 1]
    assert solids.cavities == 0
    body, touching = body_of(vertices, solids.faces, solids.solid)
    assert body.tolist() == [0, 0]
    points, triangles, twice = united(vertices, solids.faces, solids.solid)
    assert trimesh.Trimesh(points, triangles, process=False).volume == pytest.approx(1)
    assert twice == pytest.approx(icosphere(1, 0.3).volume)
    assert touching.tolist() == [[0, 1]]


def test_a_solid_in_a_cavity_stands_apart() -> None:
    vertices, faces, label = shells(box(), inverted(icosphere(2, 0.4)), icosphere(2, 0.2))
    solids = solids_of(vertices, faces, label)
    assert len(np.unique(solids.solid)) == 2
    assert body_of(vertices, solids.faces, solids.solid)[0].tolist() == [0, 1]


@pytest.mark.parametrize(("distance", "bodies"), [(1.0, 1), (1.0003, 1), (1.002, 2), (0.9, 1)])
def test_bodies_apart_by_less_than_the_surface_may_move_are_one(distance: float, bodies: int) -> None:
    vertices, faces, label = shells(box(), box(transform=moved(distance)))
    assert len(np.unique(body_of(vertices, faces, label)[0])) == bodies


def test_bodies_are_numbered_by_volume_whatever_the_order_of_the_file() -> None:
    small, middle, large = box([0.1] * 3), box([0.2] * 3, moved(1)), box([0.3] * 3, moved(2))
    assert body_of(*shells(small, large, middle))[0].tolist() == [2, 0, 1]
    assert body_of(*shells(large, middle, small))[0].tolist() == [0, 1, 2]


def test_scraps_that_enclose_nothing_are_no_solids() -> None:
    scrap = trimesh.Trimesh(
        [[5, 0, 0], [6, 0, 0], [5, 1, 0], [5, 1, 1e-9]], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    )
    solids = solids_of(*shells(box(), scrap))
    assert solids.empty == 1
    assert np.unique(solids.solid).tolist() == [-1, 0]


def test_the_gap_between_surfaces() -> None:
    vertices, faces, label = shells(box(), box(transform=moved(1.25)))
    assert gap(vertices, faces[label == 0], faces[label == 1]) == pytest.approx(0.25)


def test_inside() -> None:
    ball = icosphere(3, 1.0)
    points = np.random.default_rng(0).uniform(-1.2, 1.2, (200, 3))
    radius = np.linalg.norm(points, axis=1)
    clear = np.abs(radius - 1) > 0.02
    for faces in (ball.faces, ball.faces[:, ::-1]):
        result = inside(points, np.asarray(ball.vertices), np.asarray(faces))
        np.testing.assert_array_equal(result[clear], radius[clear] < 1)
