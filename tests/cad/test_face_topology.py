"""Half-edges in pairs: closed and open surfaces, faces the wrong way round, edges where more than two faces meet."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from trimesh.creation import box, torus

from attentionvote.cad.face_topology import apart, edges_of, face_labels, paired

Arrays = tuple[NDArray[np.float64], NDArray[np.int64]]


def arrays(mesh: trimesh.Trimesh) -> Arrays:
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def joined(*solids: trimesh.Trimesh) -> Arrays:
    """One mesh of several, equal vertices merged."""
    mesh = trimesh.util.concatenate(solids)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return arrays(mesh)


def moved(x: float, y: float, z: float) -> NDArray[np.float64]:
    return trimesh.transformations.translation_matrix([x, y, z])


def test_a_closed_surface_has_a_mate_for_every_half_edge() -> None:
    vertices, faces = arrays(torus(3, 1))
    result, mate = paired(vertices, faces)
    np.testing.assert_array_equal(result, faces)
    np.testing.assert_array_equal(mate[mate], np.arange(len(mate)))
    ends = np.roll(faces, -1, axis=1).ravel()
    np.testing.assert_array_equal(faces.ravel()[mate], ends)
    assert (edges_of(faces).uses == 2).all()


def test_open_half_edges_have_none() -> None:
    vertices, faces = arrays(box())
    _, mate = paired(vertices, faces[1:])
    assert (mate < 0).sum() == 3


@pytest.mark.parametrize("seed", range(5))
def test_faces_the_wrong_way_round_are_turned_as_most_run(seed: int) -> None:
    vertices, faces = arrays(torus(3, 1, major_sections=12, minor_sections=8))
    wrong = faces.copy()
    is_wrong = np.random.default_rng(seed).random(len(faces)) < 0.3
    wrong[is_wrong] = wrong[is_wrong, ::-1]
    result, _ = paired(vertices, wrong)
    assert trimesh.Trimesh(vertices, result, process=False).volume == pytest.approx(torus_volume())


def torus_volume() -> float:
    return float(torus(3, 1, major_sections=12, minor_sections=8).volume)


def test_a_surface_with_one_side_is_refused() -> None:
    # A Moebius band of seven corners.
    faces = np.array([[i, (i + 1) % 7, (i + 2) % 7] for i in range(7)])
    vertices = np.random.default_rng(0).normal(size=(7, 3))
    with pytest.raises(ValueError, match="one side only"):
        paired(vertices, faces)


@pytest.mark.parametrize("turn", [0.0, 0.3, 2.0])
def test_solids_that_touch_along_an_edge_are_two(turn: float) -> None:
    vertices, faces = joined(box([2, 2, 2]), box([2, 2, 2], moved(2, 2, 0)))
    vertices = trimesh.transform_points(vertices, trimesh.transformations.rotation_matrix(turn, [1, 2, 3]))
    assert (edges_of(faces).uses == 4).sum() == 1
    faces, mate = paired(vertices, faces)
    labels = face_labels(mate)
    assert (mate >= 0).all()
    assert np.bincount(labels).tolist() == [12, 12]
    split, source = apart(faces, mate)
    assert len(source) == len(vertices) + 2
    np.testing.assert_array_equal(source[split], faces)
    assert (edges_of(split).uses == 2).all()


def test_material_between_faces_decides_and_not_their_angle() -> None:
    # Two quadrants of four about an edge are empty: the solid is the other two, joined below by a plate.
    parts = [box([2, 2, 2]), box([2, 2, 2], moved(2, 2, 0)), box([6, 6, 1], moved(1, 1, -1.5))]
    vertices, faces = arrays(trimesh.boolean.union(parts))
    stand = trimesh.Trimesh(vertices, faces, process=False)
    stand.merge_vertices(merge_tex=True, merge_norm=True)
    vertices, faces = arrays(stand)
    assert (edges_of(faces).uses == 4).sum() == 1
    _, mate = paired(vertices, faces)
    assert (mate >= 0).all()
    assert face_labels(mate).max() == 0
