"""What an object's file says of size and symmetry, and sets of parts, against the surfaces."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from attentionvote.cad.builtin import BUILTIN_PARTS, builtin_surface
from attentionvote.cad.part_claims import check_claims, check_set
from attentionvote.geometry.pose import apply, matrix_from_quaternion, transform
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.part import Part


def part(mesh: trimesh.Trimesh, diameter: float, symmetry: Symmetry | None = None, name: str = "thing") -> Part:
    return Part(name, np.array(mesh.vertices), np.array(mesh.faces), diameter, symmetry or Symmetry())


BOX = trimesh.creation.box([0.1, 0.06, 0.02])
POSE = transform(matrix_from_quaternion([0.3, -0.5, 0.7, 0.4]), [0.001, 0.2, 0])


@pytest.mark.parametrize("name", BUILTIN_PARTS)
def test_what_holds_is_accepted(name: str) -> None:
    vertices, faces = builtin_surface(name)
    check_claims(Part(name, vertices, faces, BUILTIN_PARTS[name].diameter, BUILTIN_PARTS[name].symmetry))


def test_a_quarter_turn_of_a_block_of_100_x_60_is_refused_with_the_right_group() -> None:
    with pytest.raises(
        ValueError,
        match=r"thing: symmetry must leave the surface in place, but cyclic of order 4 about \(0 0 1\) carries "
        r"it 20 mm \(17% of D\) off itself; that of the mesh is dihedral of order 2 about \(1 0 0\) \(`make part`",
    ):
        check_claims(part(BOX, 0.1183, Symmetry("cyclic", order=4)))


def test_a_revolution_that_is_a_hexagon_is_accepted_within_the_tolerance_that_anyone_may_choose() -> None:
    hexagon = trimesh.creation.cylinder(0.01, 0.1, sections=12)
    check_claims(part(hexagon, 0.102, Symmetry("revolution", flip=True)))
    with pytest.raises(ValueError, match="revolution about"):
        check_claims(part(trimesh.creation.cylinder(0.05, 0.05, sections=4), 0.11, Symmetry("revolution")))


@pytest.mark.parametrize("diameter", [1.183, 0.05, 118.3])
def test_a_size_that_is_not_the_meshs_is_refused(diameter: float) -> None:
    with pytest.raises(
        ValueError, match=rf"diameter must be the size of its mesh, in metres, got {diameter:g} .*diameter: 0.118322 is"
    ):
        check_claims(part(BOX, diameter))


def test_one_mesh_in_two_frames_is_no_set() -> None:
    moved = BOX.copy()
    moved.apply_transform(POSE)
    with pytest.raises(ValueError, match="two: the parts of a set must differ in shape, but a and b are one surface"):
        check_set("two", [part(BOX, 0.118, name="a"), part(moved, 0.118, name="b")])
    grown = BOX.copy()
    grown.apply_scale(1.001)
    with pytest.raises(ValueError, match="must differ in shape"):
        check_set("two", [part(BOX, 0.118, name="a"), part(grown, 0.1182, name="b")])


def test_mirror_images_and_like_parts_are_a_set() -> None:
    boxes = [[[0, 0, 0], [0.10, 0.02, 0.02]], [[0, 0, 0], [0.02, 0.07, 0.02]], [[0, 0, 0], [0.02, 0.02, 0.045]]]
    left = trimesh.boolean.union([trimesh.creation.box(bounds=b) for b in boxes])
    right = left.copy()
    right.apply_transform(np.diag([-1.0, 1, 1, 1]))
    longer = trimesh.creation.box([0.104, 0.06, 0.02])
    check_set("two", [part(left, 0.12, name="left"), part(right, 0.12, name="right")])
    check_set("two", [part(BOX, 0.118, name="a"), part(longer, 0.122, name="b")])


def test_parts_of_sizes_too_far_apart_are_refused() -> None:
    large = trimesh.creation.box([1.0, 0.6, 0.2])
    with pytest.raises(ValueError, match=r"at most 8 times the smallest, got b of 1183 mm and a of 118.3 mm: train"):
        check_set("two", [part(BOX, 0.1183, name="a"), part(large, 1.183, name="b")])


def test_the_pose_of_a_part_does_not_matter() -> None:
    vertices = apply(POSE, BOX.vertices)
    check_claims(Part("thing", vertices, np.array(BOX.faces), 0.1183))
