"""Symmetry groups: their order, closure, and what is refused with which words."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from attentionvote.geometry.pose import matrix_from_quaternion, random_quaternion, rotation_about, rotation_angle
from attentionvote.geometry.symmetry import Symmetry

AXES = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda a: np.linalg.norm(a) > 1e-3)


def is_group(rotations: np.ndarray) -> bool:
    """Identity first, all different, closed under products, by brute force."""
    distance = np.abs(rotations[:, None] - rotations[None]).max((-2, -1)) + np.eye(len(rotations))
    products = (rotations[:, None] @ rotations[None]).reshape(-1, 1, 3, 3)
    closed = np.abs(products - rotations[None]).max((-2, -1)).min(1).max() < 1e-9
    return bool(np.allclose(rotations[0], np.eye(3)) and distance.min() > 1e-3 and closed)


def octahedral_quaternions() -> list[list[float]]:
    """The 24 rotations of a cube, scipy's list."""
    return Rotation.create_group("O").as_quat(scalar_first=True).tolist()


def test_none_has_only_the_identity() -> None:
    np.testing.assert_array_equal(Symmetry().rotations(), np.eye(3)[None])


@given(AXES, st.integers(2, 12))
def test_cyclic_is_a_group_of_turns_about_its_axis(axis: tuple[float, float, float], order: int) -> None:
    symmetry = Symmetry("cyclic", axis=axis, order=order)
    rotations = symmetry.rotations()
    assert len(rotations) == order
    assert is_group(rotations)
    np.testing.assert_allclose(rotations @ np.asarray(symmetry.axis), [symmetry.axis] * order, atol=1e-12)


@given(AXES, st.integers(2, 8))
def test_dihedral_is_a_group_of_turns_and_flips(axis: tuple[float, float, float], order: int) -> None:
    perpendicular = Symmetry("revolution", axis=axis).perpendicular
    symmetry = Symmetry("dihedral", axis=axis, order=order, flip_axis=perpendicular)
    rotations = symmetry.rotations()
    assert len(rotations) == 2 * order
    assert is_group(rotations)
    side = rotations @ np.asarray(symmetry.axis) @ np.asarray(symmetry.axis)
    np.testing.assert_allclose(np.sort(side), [-1] * order + [1] * order, atol=1e-12)


def test_group_lists_its_elements_identity_first() -> None:
    quaternions = octahedral_quaternions()
    rotations = Symmetry("group", quaternions=quaternions[::-1]).rotations()
    assert len(rotations) == 24
    assert is_group(rotations)


@pytest.mark.parametrize("flip", [False, True])
def test_revolution_enumerates_only_the_flip(flip: bool) -> None:
    symmetry = Symmetry("revolution", axis=(1, 2, 2), flip=flip)
    rotations = symmetry.rotations()
    assert symmetry.is_revolution
    assert len(rotations) == 1 + flip
    assert is_group(rotations)
    if flip:
        np.testing.assert_allclose(rotations[1] @ symmetry.axis, -np.asarray(symmetry.axis), atol=1e-12)


@given(AXES)
def test_frame_is_a_rotation_with_z_along_the_axis(axis: tuple[float, float, float]) -> None:
    symmetry = Symmetry("revolution", axis=axis)
    frame = symmetry.frame()
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1)
    np.testing.assert_allclose(frame[:, 2], np.asarray(axis) / np.linalg.norm(axis), atol=1e-12)


def test_axes_are_normalised_and_the_record_is_hashable() -> None:
    symmetry = Symmetry("cyclic", axis=(0, 0, 4), order=2)
    assert symmetry.axis == (0, 0, 1)
    assert hash(symmetry) == hash(Symmetry("cyclic", order=2))
    assert hash(Symmetry("group", quaternions=[[1, 0, 0, 0]])) != hash(Symmetry())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"kind": "mirror"}, "kind must be one of none, cyclic, dihedral, group, revolution, got 'mirror'"),
        ({"kind": "cyclic", "order": 1}, "cyclic symmetry must have a whole order of at least 2, got 1"),
        ({"kind": "dihedral", "order": 0}, "dihedral symmetry must have a whole order of at least 2, got 0"),
        ({"kind": "cyclic", "order": 2.5}, "a whole order of at least 2, got 2.5"),
        ({"kind": "cyclic", "order": 2, "axis": (0, 0, 0)}, "axis must be three finite numbers, not all zero"),
        ({"kind": "revolution", "axis": (0, float("nan"), 1)}, "axis must be three finite numbers"),
        ({"kind": "revolution", "axis": (0, 1)}, "axis must be three finite numbers"),
        ({"kind": "dihedral", "order": 2, "flip_axis": (0, 1, 1)}, "flip_axis must be perpendicular to axis"),
        ({"kind": "group"}, "a group must list its elements"),
        ({"kind": "group", "quaternions": [[1, 0, 0]]}, "quaternions of four numbers"),
    ],
)
def test_what_is_no_symmetry_is_refused(arguments: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Symmetry(**arguments)


def test_a_list_that_is_no_group_is_refused() -> None:
    third = Rotation.from_matrix(rotation_about([0, 0, 1], 2 * np.pi / 3)).as_quat(scalar_first=True).tolist()
    with pytest.raises(ValueError, match="they form no group"):
        Symmetry("group", quaternions=[[1, 0, 0, 0], third])


@pytest.mark.parametrize("bad", [[0, 0, 0, 0], [float("nan"), 0, 0, 1]])
def test_a_group_of_impossible_quaternions_is_refused(bad: list[float]) -> None:
    with pytest.raises(ValueError, match="finite numbers, not all zero"):
        Symmetry("group", quaternions=[[1, 0, 0, 0], bad])


def test_a_group_with_repeats_is_refused() -> None:
    with pytest.raises(ValueError, match="each rotation once"):
        Symmetry("group", quaternions=[[1, 0, 0, 0], [-1, 0, 0, 0]])


@pytest.mark.parametrize(
    "symmetry",
    [
        Symmetry(),
        Symmetry("cyclic", (1, 2, 2), order=3),
        Symmetry("dihedral", order=2),
        Symmetry("revolution", (1, 2, 2)),
        Symmetry("revolution", (0, 0, 1), flip=True),
    ],
    ids=lambda s: f"{s.kind} {s.flip}",
)
def test_an_angle_is_least_over_all_symmetric_poses(symmetry: Symmetry) -> None:
    """The oracle turns one pose through everything that leaves the part where it is, a body of revolution in steps."""
    a, b = matrix_from_quaternion(random_quaternion(np.random.default_rng(4), (2, 5)))
    turns = (
        rotation_about(symmetry.axis, np.linspace(0, 2 * np.pi, 7201)) if symmetry.is_revolution else np.eye(3)[None]
    )
    alike = b[:, None, None] @ symmetry.rotations()[:, None] @ turns
    expected = rotation_angle(a[:, None, None], alike).min((-2, -1))
    np.testing.assert_allclose(symmetry.angle(a, b), expected, atol=1e-3 if symmetry.is_revolution else 1e-12)
    table = symmetry.angle(a[:, None], b[None])
    np.testing.assert_array_equal(np.diagonal(table), symmetry.angle(a, b))
    assert symmetry.angle(a[:0], b[:0]).shape == (0,)
