"""Twins of parts that are nearly symmetric, and mirror images."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from attentionvote.cad.builtin import BUILTIN_PARTS, builtin_surface
from attentionvote.cad.near_symmetry import mirror_image, near_symmetries
from attentionvote.geometry.pose import rotation_about, rotation_angle
from attentionvote.geometry.symmetry import Symmetry


def rod_with_two_eyes(difference: float) -> trimesh.Trimesh:
    """A bar whose second eye is higher by ``difference``: but for that it has a half turn about z and two more."""
    bar = trimesh.creation.box([0.12, 0.02, 0.01])
    eyes = [trimesh.creation.cylinder(0.02, 0.02 + d, sections=32) for d in (0.0, difference)]
    for eye, x in zip(eyes, (-0.06, 0.06), strict=True):
        eye.apply_translation([x, 0, (eye.extents[2] - 0.02) / 2])
    return trimesh.boolean.union([bar, *eyes])


def chiral() -> trimesh.Trimesh:
    """Three arms along the axes of lengths that differ, one edge of each bevelled by position: no plane of symmetry."""
    boxes = [[[0, 0, 0], [0.10, 0.02, 0.02]], [[0, 0, 0], [0.02, 0.07, 0.02]], [[0, 0, 0], [0.02, 0.02, 0.045]]]
    return trimesh.boolean.union([trimesh.creation.box(bounds=b) for b in boxes])


def test_the_twin_of_a_rod_that_is_not_quite_symmetric_is_listed() -> None:
    rod = rod_with_two_eyes(0.004)
    twins = near_symmetries(np.array(rod.vertices), rod.faces, Symmetry(), 0.16)
    assert twins
    about_z = [t for t in twins if rotation_angle(t.rotation, rotation_about((0, 0, 1), np.pi)) < 0.1]
    assert len(about_z) == 1
    assert 0.6 < about_z[0].overlap < 1
    assert about_z[0].largest == pytest.approx(0.004, abs=0.001)
    assert [t.overlap for t in twins] == sorted((t.overlap for t in twins), reverse=True)


def test_a_symmetry_of_the_part_is_no_twin_and_a_sphere_like_turn_is_listed_once() -> None:
    box = trimesh.creation.box([0.1, 0.06, 0.03])
    exact = Symmetry("dihedral", order=2)
    assert near_symmetries(np.array(box.vertices), box.faces, exact, 0.12) == []
    unsaid = near_symmetries(np.array(box.vertices), box.faces, Symmetry("cyclic", order=2), 0.12)
    assert len(unsaid) == 1  # the other two half turns are one up to the symmetry
    assert unsaid[0].overlap == 1


def test_translations_belong_to_the_frame_of_the_part() -> None:
    box = trimesh.creation.box([0.1, 0.06, 0.03])
    shift = np.array([0.2, -0.1, 0.05])
    twins = near_symmetries(box.vertices + shift, box.faces, Symmetry(), 0.12)
    exact = [twin for twin in twins if twin.overlap == 1]
    assert exact
    for twin in exact:
        np.testing.assert_allclose(twin.rotation @ shift + twin.translation, shift, atol=1e-4)


def test_a_plane_of_symmetry_makes_the_mirror_image_the_part() -> None:
    for name in ("connecting_rod", "vertical_bearing_pedestal"):
        vertices, faces = builtin_surface(name)
        mirrored = mirror_image(vertices, faces, BUILTIN_PARTS[name].diameter)
        assert np.linalg.det(mirrored.rotation) == pytest.approx(-1)
        assert mirrored.overlap == 1
        assert mirrored.largest < 3e-4 * BUILTIN_PARTS[name].diameter


def test_the_mirror_image_of_a_chiral_part_is_another_part() -> None:
    part = chiral()
    mirrored = mirror_image(np.array(part.vertices), part.faces, 0.12)
    assert mirrored.overlap < 0.95
    assert mirrored.largest > 0.005
