"""Parts: exact surface integrals against brute force, the metric's matrix, the digest, what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.geometry.pose import matrix_from_quaternion, random_quaternion
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.part import Part, PartSet, surface_moments

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
FACES = np.array([[q[i] for i in t] for q in QUADS for t in ((0, 1, 2), (0, 2, 3))])


def box(size: tuple[float, float, float] = (0.1, 0.04, 0.02), **changes: object) -> Part:
    """A box of ``size`` metres centred at the origin."""
    arguments = {"vertices": (CORNERS - 0.5) * size, "faces": FACES, "diameter": math.dist((0, 0, 0), size)}
    return Part("box", **{**arguments, **changes})  # type: ignore[arg-type]


def random_surface(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A random soup of triangles; the moments do not ask for a closed surface."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(12, 3)), np.array([rng.permutation(12)[:3] for _ in range(9)])


def subdivided_moments(vertices: np.ndarray, faces: np.ndarray, level: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Brute force: split every triangle into 4**level and treat each piece as a point."""
    triangles = vertices[faces]
    for _ in range(level):
        a, b, c = np.moveaxis(triangles, 1, 0)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        pieces = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        triangles = np.concatenate([np.stack(p, axis=1) for p in pieces])
    weight = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1) / 2
    centre = triangles.mean(1)
    centroid = weight @ centre / weight.sum()
    return weight.sum(), centroid, (centre - centroid).T * weight @ (centre - centroid) / weight.sum()


@given(st.integers(0, 1000))
def test_surface_moments_equal_brute_force(seed: int) -> None:
    vertices, faces = random_surface(seed)
    area, centroid, covariance = surface_moments(vertices, faces)
    expected = subdivided_moments(vertices, faces, 4)
    assert area == pytest.approx(expected[0], rel=1e-12)
    np.testing.assert_allclose(centroid, expected[1], atol=1e-12)
    # A piece counts as a point: its own spread, (edge / 16)^2 / 12 or so of the triangle's, is what is missing.
    np.testing.assert_allclose(covariance, expected[2], atol=0.01)


def test_surface_moments_of_a_cube_surface_are_the_textbook_values() -> None:
    # Of the six faces two lie at +-1/2 (second moment 1/4) and four spread uniformly (1/12): (2/4 + 4/12) / 6 = 5/36.
    area, centroid, covariance = surface_moments(CORNERS, FACES)
    assert area == pytest.approx(6)
    np.testing.assert_allclose(centroid, 0.5)
    np.testing.assert_allclose(covariance, np.eye(3) * 5 / 36, atol=1e-15)


@given(st.integers(0, 1000))
def test_surface_moments_follow_rigid_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vertices, faces = random_surface(seed)
    r, t = matrix_from_quaternion(random_quaternion(rng)), rng.normal(size=3)
    area, centroid, covariance = surface_moments(vertices, faces)
    moved = surface_moments(vertices @ r.T + t, faces)
    assert moved[0] == pytest.approx(area)
    np.testing.assert_allclose(moved[1], r @ centroid + t, atol=1e-12)
    np.testing.assert_allclose(moved[2], r @ covariance @ r.T, atol=1e-12)


def test_covariance_root_squares_to_the_covariance() -> None:
    part = box()
    root = part.covariance_root
    np.testing.assert_allclose(root, root.T, atol=1e-18)
    np.testing.assert_allclose(root @ root, surface_moments(part.vertices, part.faces)[2], atol=1e-15)
    assert np.linalg.eigvalsh(root).min() > 0


def test_surface_points_lie_on_the_surface_in_proportion_to_area() -> None:
    size = np.array([0.1, 0.04, 0.02])
    points = box().surface_points(20_000, np.random.default_rng(0))
    at_wall = np.isclose(np.abs(points), size / 2, rtol=0, atol=1e-12)
    assert at_wall.any(axis=1).all()
    assert (np.abs(points) <= size / 2 + 1e-12).all()
    # Faces perpendicular to x have area 2 y z, and so on; four standard deviations of 20,000 draws are 0.014.
    area = np.prod(size) / size
    np.testing.assert_allclose(at_wall.mean(0), area / area.sum(), atol=0.014)
    np.testing.assert_allclose(points.mean(0) / size, 0, atol=0.014)


def test_surface_points_are_the_same_for_the_same_generator() -> None:
    first, second = (box().surface_points(7, np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_digest_is_of_what_the_part_is_and_not_of_its_name() -> None:
    part = box()
    assert part.digest == box(title="another title").digest
    assert part.digest == Part("other", part.vertices + 1e-13, part.faces, part.diameter).digest
    different = [
        box(diameter=part.diameter + 1e-6),
        box(symmetry=Symmetry("cyclic", order=2)),
        box(size=(0.1, 0.04, 0.021)),
        box(faces=FACES[::-1]),
    ]
    assert len({part.digest, *(p.digest for p in different)}) == 5


def test_digest_knows_no_negative_zero() -> None:
    assert box(vertices=np.where(CORNERS == 0, -0.0, CORNERS)).digest == box(vertices=CORNERS).digest


NAN = np.where(np.arange(24).reshape(8, 3) == 5, np.nan, CORNERS)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"vertices": CORNERS[:3]}, r"box: vertices must be \(V, 3\) with V >= 4, got shape \(3, 3\)"),
        ({"vertices": CORNERS[:, :2]}, r"got shape \(8, 2\)"),
        ({"vertices": NAN}, "vertices must be finite, got 1 NaN or inf"),
        ({"faces": FACES[:3]}, r"faces must be \(F, 3\) with F >= 4"),
        ({"faces": FACES + 1}, r"faces must index 8 vertices, got 1\.\.8"),
        ({"faces": FACES - 1}, r"faces must index 8 vertices, got -1\.\.6"),
        ({"diameter": 0.0}, "diameter must be positive metres, got 0.0"),
        ({"diameter": math.nan}, "diameter must be positive metres, got nan"),
        ({"vertices": CORNERS * [1, 0, 0]}, "surface must have an area"),
    ],
)
def test_impossible_parts_are_refused(changes: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        box(**changes)


def test_a_set_of_one_part_is_that_part() -> None:
    part = box()
    alone = PartSet("bin", (part,))
    assert alone.digest == part.digest
    assert alone.diameter == part.diameter
    np.testing.assert_array_equal(alone.box, part.box)
    assert alone.parts == part.parts == (part,)


def test_a_set_is_as_large_as_its_largest_part_and_knows_the_order() -> None:
    long, wide = box((0.1, 0.04, 0.02)), replace(box((0.05, 0.06, 0.03)), name="wide")
    both = PartSet("bin", (long, wide))
    assert both.diameter == long.diameter
    np.testing.assert_allclose(both.box, [[-0.05, -0.03, -0.015], [0.05, 0.03, 0.015]])
    assert len({both.digest, PartSet("bin", (wide, long)).digest, long.digest, wide.digest}) == 4
    assert PartSet("other", (long, replace(wide, name="broad"))).digest == both.digest


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ((), "bin: a set must have at least one part, got none"),
        ((box(), box((0.2, 0.1, 0.1))), "bin: the parts of a set must have names of their own, got box twice"),
        ((box(), replace(box(), name="twin")), "bin: the parts of a set must differ, but box is twin"),
    ],
)
def test_impossible_sets(parts: tuple[Part, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PartSet("bin", parts)
