"""The self-test: a bundle passes its own golden clouds, and any other answer is told in a sentence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.evaluation.pose_distance import rotation_errors
from attentionvote.geometry.pose import matrix_from_quaternion as matrix
from attentionvote.geometry.pose import quaternion_from_matrix, random_quaternion, rotation_about, transform
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.inference import Bundle, Crop, PoseEstimator, load_bundle, self_test
from attentionvote.inference.golden import clear_confidence, pose_errors

MakeBundle = Callable[..., Path]
Try = Callable[..., list[str]]
HALF = 0.5**0.5
QUATERNIONS = np.array([(1.0, 0.0, 0.0, 0.0), (HALF, 0.0, 0.0, HALF), (0.5, 0.5, 0.5, 0.5), (0.0, 1.0, 0.0, 0.0)])


@pytest.fixture
def tried(make_bundle: MakeBundle, trusted_key: Path, make_graph: Callable[..., Any]) -> Try:
    """Problems of a graph with other answers, on the golden clouds of the tiny one."""

    def attempt(card: dict[str, Any] | None = None, crop: Crop | None = None, **graph: Any) -> list[str]:
        bundle = load_bundle(make_bundle(card=card), trusted_key)
        model = make_graph(bundle.card, **graph).SerializeToString()
        with PoseEstimator(replace(bundle, model=model), crop=crop) as estimator:
            return self_test(estimator, bundle)

    return attempt


def turned(axis: list[float], degrees: float) -> NDArray[np.float64]:
    """The tiny graph's quaternions with every part turned about an axis of its own."""
    return quaternion_from_matrix(matrix(QUATERNIONS) @ rotation_about(axis, np.radians(degrees)))


def moved(millimetres: float) -> list[list[float]]:
    """The tiny graph's offsets, moved along x."""
    return [[x + millimetres / 1000, y, 0] for x, y in ((0.0, 0.0), (0.05, 0.0), (-0.05, 0.0), (0.0, 0.05))]


def test_a_bundle_passes_its_own_clouds(make_bundle: MakeBundle, trusted_key: Path) -> None:
    bundle = load_bundle(make_bundle(golden=3), trusted_key)
    with PoseEstimator(bundle) as estimator:
        assert self_test(estimator, bundle) == []


def test_the_cells_crop_is_not_applied(tried: Try) -> None:
    assert tried(crop=Crop(transform(np.diag([1, -1, -1]), [0, 0, 2.0]), np.full(3, 0.2))) == []


def test_within_the_tolerances_nothing_is_said(tried: Try) -> None:
    assert tried(quaternions=turned([0, 1, 0], 0.9), offsets=moved(0.9)) == []


def test_a_pose_that_moved_is_said(tried: Try) -> None:
    problems = tried(offsets=moved(1.1))
    # Two poses are clear of the threshold; each is missed at its place and extra at the new one.
    assert len(problems) == 4
    assert problems[0] == (
        "golden cloud cloud_0 must give pose 0 with confidence 0.95 again within 1 mm and 1 degree, "
        "but the nearest is off by 1.10 mm and 0.00 degrees"
    )
    assert problems[2].startswith("golden cloud cloud_0 gave a pose at (")
    assert problems[2].endswith("with confidence 0.95 that was not there when the bundle was made")


def test_a_pose_that_turned_is_said(tried: Try) -> None:
    problems = tried(quaternions=turned([0, 1, 0], 1.1))
    assert len(problems) == 4
    assert "off by 0.00 mm and 1.10 degrees" in problems[0]


def test_a_pose_that_is_gone_or_all_of_them(tried: Try) -> None:
    problems = tried(confidence=(0.7, 0.1, 0.3, 0.99))
    assert len(problems) == 1
    assert (
        "must give pose 0 with confidence 0.95 again within 1 mm and 1 degree, but the nearest is off by 50"
        in problems[0]
    )


def test_no_pose_at_all_is_said(tried: Try) -> None:
    problems = tried(confidence=(0.0,) * 4)
    assert [problem.split(" again, ")[1] for problem in problems] == ["but gave no pose at all"] * 2


def test_a_clear_extra_pose_is_said_and_a_doubled_one(tried: Try) -> None:
    extra = tried(heat=(9, 6, 3, 1))
    assert len(extra) == 1
    assert "with confidence 0.99 that was not there" in extra[0]


def test_a_doubled_pose_is_said(tried: Try) -> None:
    where, turns = [[0, 0, 0], [0.05, 0, 0], [-0.05, 0, 0], [0, 0, 0]], QUATERNIONS[[0, 1, 2, 0]]
    problems = tried(heat=(9, 6, 3, 1), offsets=where, quaternions=turns)
    assert len(problems) == 1
    assert "that was not there when the bundle was made" in problems[0]


@pytest.mark.parametrize(("expected", "told"), [(0.59, 0), (0.61, 1)])
def test_a_pose_near_the_threshold_may_go(
    make_bundle: MakeBundle, trusted_key: Path, make_graph: Callable[..., Any], expected: float, told: int
) -> None:
    bundle = load_bundle(make_bundle(graph={"confidence": (expected, 0.95, 0.3, 0.99)}), trusted_key)
    model = make_graph(bundle.card, confidence=(0.4, 0.95, 0.3, 0.99)).SerializeToString()
    with PoseEstimator(replace(bundle, model=model)) as estimator:
        assert len(self_test(estimator, bundle)) == told


@pytest.mark.parametrize(("answered", "told"), [(0.59, 0), (0.61, 1)])
def test_a_pose_near_the_threshold_may_come(tried: Try, answered: float, told: int) -> None:
    assert len(tried(confidence=(0.7, 0.95, answered, 0.99))) == told


def test_an_unclear_expected_pose_explains_an_answer(make_bundle: MakeBundle, trusted_key: Path) -> None:
    # What was there with little confidence is no extra pose when it comes back with more.
    folder = make_bundle("low", graph={"confidence": (0.52, 0.95, 0.3, 0.99)})
    bundle = load_bundle(folder, trusted_key)
    own = load_bundle(make_bundle("high", graph={"confidence": (0.75, 0.95, 0.3, 0.99)}), trusted_key)
    with PoseEstimator(own) as estimator:
        assert self_test(estimator, bundle) == []


CYCLIC = {"kind": "cyclic", "axis": [0, 0, 1], "order": 3}
ROUND = {"kind": "revolution", "axis": [0, 0, 1]}
FLIPPED = ROUND | {"flip": True}


@pytest.mark.parametrize(
    ("symmetry", "axis", "degrees", "same"),
    [
        (CYCLIC, [0, 0, 1], 120, True),
        (CYCLIC, [0, 0, 1], -119.5, True),
        (CYCLIC, [0, 0, 1], 60, False),
        (CYCLIC, [1, 0, 0], 180, False),
        (ROUND, [0, 0, 1], 77, True),
        (ROUND, [1, 0, 0], 180, False),
        (ROUND, [1, 0, 0], 1.2, False),
        (FLIPPED, [1, 0, 0], 180, True),
        (FLIPPED, [0, 1, 0], 179.5, True),
        (FLIPPED, [0, 1, 0], 90, False),
    ],
)
def test_poses_are_compared_up_to_the_parts_symmetry(
    tried: Try, symmetry: dict[str, Any], axis: list[float], degrees: float, same: bool
) -> None:
    problems = tried(card={"part": {"symmetry": symmetry}}, quaternions=turned(axis, degrees))
    assert bool(problems) != same


@given(
    st.sampled_from(
        [
            Symmetry(),
            Symmetry("cyclic", order=4),
            Symmetry("dihedral", order=2),
            Symmetry("revolution", axis=(1, 1, 0)),
            Symmetry("revolution", flip=True),
        ]
    ),
    st.integers(0, 2**32 - 1),
)
def test_errors_are_those_of_the_evaluation(symmetry: Symmetry, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = (transform(matrix(random_quaternion(rng, (3,))), rng.normal(size=(3, 3))) for _ in range(2))
    translation, rotation = pose_errors(a, b, symmetry)
    for i in range(3):
        np.testing.assert_allclose(rotation[i], rotation_errors(np.repeat(a[i : i + 1], 3, 0), b, symmetry), atol=1e-6)
        np.testing.assert_allclose(translation[i], np.linalg.norm(a[i, :3, 3] - b[:, :3, 3], axis=1))


def test_errors_of_no_poses_are_empty() -> None:
    for symmetry in (Symmetry(), Symmetry("revolution", flip=True)):
        translation, rotation = pose_errors(np.zeros((2, 4, 4)), np.zeros((0, 4, 4)), symmetry)
        assert translation.shape == rotation.shape == (2, 0)


def test_a_cloud_that_cannot_be_estimated_and_one_that_is_none(
    make_bundle: MakeBundle, trusted_key: Path, make_card: Callable[..., ModelCard]
) -> None:
    def millimetres(folder: Path) -> None:
        path = folder / "golden" / "cloud_0.npz"
        with np.load(path) as stored:
            arrays = dict(stored)
        np.savez(path, **arrays | {"points": arrays["points"] * np.float32(1000)})

    bundle = load_bundle(make_bundle("mm", change=millimetres), trusted_key)
    with PoseEstimator(bundle) as estimator:
        assert "golden cloud cloud_0 could not be estimated: points must be metres" in self_test(estimator, bundle)[0]
        broken = Bundle(bundle.path, make_card(), bundle.digest, bundle.model, {"golden/a.npz": b"junk"})
        assert self_test(estimator, broken) == [
            "golden/a.npz must be a golden cloud, but it is no .npz archive, or damaged: export the bundle again"
        ]


@pytest.mark.parametrize(
    ("threshold", "clear"), [(0.0, 0.1), (0.5, 0.6), (0.6, 0.7), (0.9, 0.925), (0.98, 0.985), (1.0, 1.1), (40.0, 44.0)]
)
def test_a_clear_confidence_can_be_reached_and_lies_above_the_threshold(threshold: float, clear: float) -> None:
    assert clear_confidence(threshold) == pytest.approx(clear)
