"""The group nearest to a list of rotations: every kind, perturbed or rounded, and what is near none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from attentionvote.geometry.nearest_symmetry import TOLERANCE, exact_group, nearest_symmetry
from attentionvote.geometry.pose import rotation_about, rotation_angle
from attentionvote.geometry.symmetry import Symmetry

KINDS = st.one_of(
    st.tuples(st.just("cyclic"), st.integers(2, 72)),
    st.tuples(st.just("dihedral"), st.integers(2, 72)),
    st.tuples(st.sampled_from("TOI"), st.just(0)),
)
SIZES = {"T": 12, "O": 24, "I": 60}


def elements(kind: str, order: int) -> np.ndarray:
    """Every rotation of a group, the identity first."""
    if kind in SIZES:
        group = Rotation.create_group(kind).as_matrix()
        return group[np.argsort(rotation_angle(group, np.eye(3)), kind="stable")]
    return Symmetry(kind, (0, 0, 1), order).rotations()  # type: ignore[arg-type]


def same_group(symmetry: Symmetry, group: np.ndarray, within: float) -> bool:
    """Whether both have as many rotations, each within so many radians of one of the other."""
    found = symmetry.rotations()
    apart = rotation_angle(found[:, None], group)
    return len(found) == len(group) and max(apart.min(0).max(), apart.min(1).max()) < within


def perturbed(rng: np.random.Generator, rotations: np.ndarray, angle: float) -> np.ndarray:
    """Each turned by ``angle`` about a direction of its own."""
    direction = rng.normal(size=(len(rotations), 3))
    vector = angle * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return Rotation.from_rotvec(vector).as_matrix() @ rotations


def rounded(rotations: np.ndarray, digits: int) -> np.ndarray:
    """The nearest rotations of rounded numbers."""
    left, _, right = np.linalg.svd(np.round(rotations, digits))
    return np.asarray(left @ right)


def listed(rng: np.random.Generator, group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The group in a frame of its own, and its list: without the identity, in any order."""
    frame = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    group = frame @ group @ frame.T
    return group, group[1:][rng.permutation(len(group) - 1)]


@settings(max_examples=60, deadline=None)
@given(KINDS, st.integers(0, 2**31), st.floats(0, 2))
def test_a_whole_group_that_is_up_to_two_degrees_off_is_found(kind: tuple[str, int], seed: int, degrees: float) -> None:
    rng = np.random.default_rng(seed)
    group, rotations = listed(rng, elements(*kind))
    found = nearest_symmetry(perturbed(rng, rotations, np.radians(degrees)))
    assert found is not None
    assert same_group(found[0], group, 1e-7 + np.radians(1.3 * degrees))
    assert found[0].kind == (kind[0] if kind[0] not in SIZES else "group")
    assert 0.2 * np.radians(degrees) - 1e-7 <= found[1] <= min(TOLERANCE, 1e-7 + np.radians(1.5 * degrees))


@settings(max_examples=60, deadline=None)
@given(KINDS, st.integers(0, 2**31), st.integers(3, 6))
def test_a_whole_group_that_is_rounded_is_found(kind: tuple[str, int], seed: int, digits: int) -> None:
    rng = np.random.default_rng(seed)
    group, rotations = listed(rng, elements(*kind))
    found = nearest_symmetry(rounded(rotations, digits))
    assert found is not None
    assert same_group(found[0], group, 2 * 10.0**-digits)
    assert found[1] < 2 * 10.0**-digits


@settings(max_examples=60, deadline=None)
@given(KINDS, st.integers(0, 2**31))
def test_an_exact_group_stays_as_it_is(kind: tuple[str, int], seed: int) -> None:
    group, rotations = listed(np.random.default_rng(seed), elements(*kind))
    # The identity may be listed, and a rotation twice.
    found = nearest_symmetry(np.concatenate([rotations, np.eye(3)[None], rotations[:1]]))
    assert found is not None
    assert same_group(found[0], group, 1e-9)
    assert found[1] < 1e-9


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 72), st.booleans(), st.integers(0, 2**31), st.integers(5, 12))
def test_generators_that_are_nearly_exact_stand_for_their_group(
    order: int, flips: bool, seed: int, digits: int
) -> None:
    rng = np.random.default_rng(seed)
    group = elements("dihedral" if flips else "cyclic", order)
    frame = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    generators = frame @ group[[1, order] if flips else [1]] @ frame.T
    found = nearest_symmetry(rounded(generators, digits))
    assert found is not None
    assert same_group(found[0], frame @ group @ frame.T, 72 * 10.0**-digits)


@pytest.mark.parametrize("degrees", [58.5, 60.0, 61.5])
def test_a_coarse_generator_of_a_small_group_stands_for_it(degrees: float) -> None:
    found = nearest_symmetry(rotation_about((0, 0, 1), np.radians(degrees))[None])
    assert found is not None
    assert (found[0].kind, found[0].order) == ("cyclic", 6)
    assert np.degrees(found[1]) == pytest.approx(abs(degrees - 60))


@pytest.mark.parametrize("kind", SIZES)
def test_two_coarse_generators_of_a_polyhedron_stand_for_its_group(kind: str) -> None:
    rng = np.random.default_rng(4)
    group = elements(kind, 0)
    order = {"T": 3, "O": 4, "I": 5}[kind]
    angles = rotation_angle(group, np.eye(3))
    turns = group[np.abs(angles - 2 * np.pi / order) < 1e-6]
    other = next(turn for turn in turns if np.abs(turn @ turns[0] - turns[0] @ turn).max() > 0.1)
    found = nearest_symmetry(perturbed(rng, np.stack([turns[0], other]), np.radians(1.5)))
    assert found is not None
    # Two rotations say little about the frame.
    assert same_group(found[0], group, np.radians(8))
    assert found[1] < TOLERANCE


def test_nothing_and_the_identity_are_no_symmetry() -> None:
    assert nearest_symmetry(np.zeros((0, 3, 3))) == (Symmetry(), 0.0)
    assert nearest_symmetry(np.eye(3)[None]) == (Symmetry(), 0.0)


def test_a_group_with_an_identity_that_is_off_is_found() -> None:
    half, off = rotation_about((1, 0, 0), np.pi), rotation_about((0, 1, 0), np.radians(1.5))
    found = nearest_symmetry(np.stack([off, half]))
    assert found is not None
    assert (found[0].kind, found[0].order) == ("cyclic", 2)


@pytest.mark.parametrize(
    "rotations",
    [
        rotation_about((0, 0, 1), np.radians(175))[None],
        rotation_about((0, 0, 1), np.radians(160))[None],
        Rotation.random(2, random_state=0).as_matrix(),
        Rotation.random(11, random_state=1).as_matrix(),
        Rotation.random(400, random_state=2).as_matrix(),
    ],
)
def test_what_is_near_no_group_is_none(rotations: np.ndarray) -> None:
    assert nearest_symmetry(rotations) is None


def test_one_rotation_that_is_missing_is_not_shared_out_among_the_others() -> None:
    # 118 of 120 turns are within 3 degrees of a group of 119, but not within half of its step.
    rotations = elements("cyclic", 120)[np.r_[1:60, 61:120]]
    found = nearest_symmetry(rotations)
    assert found is not None
    assert (found[0].order, found[1] < 1e-9) == (120, True)


@settings(max_examples=20, deadline=None)
@given(st.sampled_from("TOI"), st.integers(0, 2**31))
def test_the_mean_of_all_products_is_a_group(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    group = elements(kind, 0)
    found = exact_group(np.concatenate([group[:1], perturbed(rng, group[1:], np.radians(2))]))
    products = np.einsum("aij,bjk->abik", found, found).reshape(-1, 1, 3, 3)
    assert rotation_angle(products, found).min(1).max() < 1e-7
