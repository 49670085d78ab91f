"""Surfaces that touch along an edge, set apart so that a file of merged vertices keeps them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from trimesh.creation import box

from attentionvote.cad.face_topology import edges_of
from attentionvote.cad.healing import Changes, healed
from attentionvote.cad.mesh_file import load_surface, write_surface
from attentionvote.cad.touching_edges import SET_APART, set_apart


def moved(x: float, y: float, z: float) -> NDArray[np.float64]:
    return trimesh.transformations.translation_matrix([x, y, z])


PLATE = box([0.6, 0.6, 0.05], moved(0.1, 0.1, -0.125))
CUBES = [box([0.2, 0.2, 0.2]), box([0.2, 0.2, 0.2], moved(0.2, 0.2, 0))]


@pytest.mark.parametrize(
    "mesh",
    [trimesh.util.concatenate(CUBES), trimesh.boolean.union([*CUBES, PLATE])],
    ids=["two solids", "one, whose edge ends in a plate"],
)
def test_a_shared_edge_becomes_two_and_is_read_back(tmp_path: Path, mesh: trimesh.Trimesh) -> None:
    write_surface(np.asarray(mesh.vertices), np.asarray(mesh.faces), tmp_path / "touching.ply")
    with pytest.raises(ValueError, match="1 edges of more than two faces"):
        load_surface(tmp_path / "touching.ply")
    whole = healed(np.asarray(mesh.vertices), np.asarray(mesh.faces), Changes(), 100.0)
    vertices, faces, count = set_apart(whole)
    assert count == 1
    assert (edges_of(faces).uses == 2).all()
    write_surface(vertices * 0.1, faces, tmp_path / "apart.ply")
    back, triangles = load_surface(tmp_path / "apart.ply")
    assert trimesh.Trimesh(back, triangles).volume == pytest.approx(mesh.volume * 1e-3, rel=1e-3)
    # Into the material, and no farther than it says.
    assert trimesh.Trimesh(vertices, faces, process=False).volume < mesh.volume
    away = trimesh.proximity.closest_point_naive(mesh, vertices)[1]
    assert away.max() <= SET_APART * (1 + 1e-6)


def test_without_shared_edges_nothing_moves() -> None:
    cube = box()
    whole = healed(np.asarray(cube.vertices), np.asarray(cube.faces), Changes(), 1.0)
    vertices, faces, count = set_apart(whole)
    assert count == 0
    np.testing.assert_array_equal(vertices[faces], cube.triangles)
