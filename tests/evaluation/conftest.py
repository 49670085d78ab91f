"""Fixtures of the evaluation tests: parts small enough to reason about, scenes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from attentionvote.evaluation import SceneResult
from attentionvote.geometry.pose import matrix_from_quaternion, random_quaternion, rotation_about, transform
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.part import Part

BOX_FACES = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]]
BOX_FACES += [[0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]


def make_box(symmetry: Symmetry | None = None, half: tuple[float, float, float] = (0.02, 0.01, 0.06)) -> Part:
    """A box whose diameter is called 100 mm, so that 10 % D is 10 mm."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    return Part("box", corners, np.array(BOX_FACES), 0.1, symmetry or Symmetry())


# Functions as fixtures of the session: test modules cannot import each other, and hypothesis wants no other scope.
@pytest.fixture(scope="session")
def box() -> Callable[..., Part]:
    return make_box


@pytest.fixture(scope="session")
def make_poses() -> Callable[..., np.ndarray]:
    return random_poses


@pytest.fixture(scope="session")
def make_scene() -> Callable[..., SceneResult]:
    return random_scene


def random_poses(rng: np.random.Generator, count: int, extent: float = 0.2) -> np.ndarray:
    rotation = matrix_from_quaternion(random_quaternion(rng, (count,)))
    return transform(rotation, rng.uniform(-extent, extent, (count, 3)))


def random_scene(
    rng: np.random.Generator, results: int = 12, truths: int = 8, noise_m: float = 0.004, decimals: int = 1
) -> SceneResult:
    """Results scattered about the truth with duplicates and false positives; few decimals give tied scores."""
    gt = random_poses(rng, truths)
    poses = random_poses(rng, results)
    if truths:
        for i in np.flatnonzero(rng.random(results) < 0.8):
            turn = rotation_about(rng.normal(size=3), rng.normal() * 0.05)
            poses[i] = gt[rng.integers(truths)] @ transform(turn, rng.normal(size=3) * noise_m)
    scores = np.round(rng.random(results), decimals)
    return SceneResult(poses, scores, gt, rng.choice([0.0, 0.3, 0.5, 0.6, 0.95], truths))


@pytest.fixture
def scenes() -> list[SceneResult]:
    rng = np.random.default_rng(5)
    sizes = [(12, 8), (20, 5), (0, 4), (3, 0), (1, 1), (30, 10), (0, 0)]
    return [random_scene(rng, results, truths) for results, truths in sizes]
