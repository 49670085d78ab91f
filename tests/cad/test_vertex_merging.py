"""Vertices a rounding apart, cracks, and faces that are there twice."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from trimesh.creation import box, icosphere

from attentionvote.cad.face_topology import edges_of
from attentionvote.cad.vertex_merging import MERGED, distinct, merged, zipped


def test_equal_vertices_are_the_first_of_them_and_none_moves() -> None:
    points = np.array([[1.0, 0, 0], [0, 0, 0], [1.0, 0, 0], [-0.0, 0, 0]])
    stand, moved, count = merged(points)
    assert stand.tolist() == [0, 1, 0, 1]
    assert (moved, count) == (0.0, 0)


def test_vertices_a_rounding_apart_are_one_and_others_are_not() -> None:
    points = np.array([[0.0, 0, 0], [0.9 * MERGED, 0, 0], [0.5, 0, 0], [0.5 + 1.1 * MERGED, 0, 0]])
    stand, moved, count = merged(points)
    assert stand.tolist() == [0, 0, 2, 3]
    assert moved == pytest.approx(0.9 * MERGED)
    assert count == 1


def cut_in_two(gap: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """A ball of two halves that share no vertex."""
    ball = icosphere(2, 0.5)
    is_right = ball.triangles_center[:, 0] > 0
    right = ball.vertices + np.array([gap, 0, 0])
    faces = np.concatenate([ball.faces[~is_right], ball.faces[is_right] + len(ball.vertices)])
    return np.concatenate([ball.vertices, right]), faces


def test_a_crack_is_joined_in_its_middle() -> None:
    vertices, faces = cut_in_two(1e-4)
    assert (edges_of(faces).uses == 1).any()
    joined, same, moved = zipped(vertices, faces, 2e-4)
    assert (edges_of(same).uses == 2).all()
    assert moved == pytest.approx(5e-5)
    assert np.abs(joined - vertices).max() == pytest.approx(5e-5)


def test_a_crack_wider_than_asked_for_stays() -> None:
    vertices, faces = cut_in_two(1e-3)
    _, same, moved = zipped(vertices, faces, 2e-4)
    np.testing.assert_array_equal(same, faces)
    assert moved == 0


def test_copies_of_faces_go_however_their_corners_are_numbered() -> None:
    faces = np.asarray(box().faces)
    result = distinct(np.concatenate([faces, np.roll(faces[:5], 1, axis=1)]))
    np.testing.assert_array_equal(result.faces, faces)
    assert (result.repeated, len(result.removed)) == (5, 0)


def test_faces_of_two_corners_go_and_open_nothing() -> None:
    faces = np.asarray(box().faces).copy()
    faces[faces == 7] = 3  # an edge collapses
    result = distinct(faces)
    assert len(result.faces) < len(faces)
    assert (edges_of(result.faces).uses == 2).all()


def test_an_opposite_pair_goes_and_a_body_there_from_both_sides_stays_once() -> None:
    faces = np.asarray(box().faces)
    # Two tetrahedra on one face: what is between them is inside.
    low = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
    high = np.array([[0, 2, 1], [0, 1, 4], [1, 2, 4], [2, 0, 4]])
    result = distinct(np.concatenate([low, high]))
    assert len(result.faces) == 6
    assert len(result.removed) == 1
    assert (edges_of(result.faces).uses == 2).all()
    double = distinct(np.concatenate([faces, faces[:, ::-1]]))
    assert (len(double.faces), double.repeated, len(double.removed)) == (12, 12, 0)
