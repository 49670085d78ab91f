"""The estimator with real bundles and sessions: poses, abstentions, deadlines, cameras, crops."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from attentionvote.geometry.pose import rotation_about, transform
from attentionvote.inference import (
    Abstention,
    BundleError,
    CameraIntrinsics,
    Crop,
    Estimate,
    InputError,
    PoseEstimator,
    load_bundle,
)

MakeBundle = Callable[..., Path]
MakeCloud = Callable[..., NDArray[np.float32]]
CROP = Crop(transform(rotation_about([1, 0, 0], np.pi), [0, 0, 0.85]), np.array([0.3, 0.3, 0.1]))

LEFT_OUT = "1 poses above the thresholds lie outside the scan or are none, and were left out"


@pytest.fixture
def estimator(bundle_folder: Path, trusted_key: Path) -> PoseEstimator:
    """Of the intact bundle."""
    return PoseEstimator(bundle_folder, trusted=trusted_key)


def test_poses_above_the_thresholds_most_confident_first(estimator: PoseEstimator, make_cloud: MakeCloud) -> None:
    cloud = make_cloud()
    answer = estimator.estimate(cloud)
    assert isinstance(answer, Estimate)
    # Of four proposals one has no heat and one too little confidence.
    assert [round(d.confidence, 3) for d in answer.detections] == [0.95, 0.7]
    assert [d.heat for d in answer.detections] == [6.0, 9.0]
    assert [d.part for d in answer.detections] == ["bracket", "bracket"]
    first, second = (d.camera_from_part for d in answer.detections)
    np.testing.assert_allclose(second[:3, 3], cloud.mean(axis=0), atol=0.02)  # of a sample of the points
    np.testing.assert_allclose(first[:3, 3] - second[:3, 3], [0.05, 0, 0], atol=1e-6)
    np.testing.assert_allclose(first[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-6)
    assert first.dtype == np.float64
    assert (answer.points_given, answer.points_used, answer.warnings) == (3000, 3000, ())
    assert answer.part == "bracket"
    assert estimator.digest.startswith(answer.model)
    assert set(answer.seconds) == {"read", "prepare", "graph", "total"}
    assert sum(answer.seconds.values()) <= 2 * answer.seconds["total"]
    json.dumps(answer.to_dict(), allow_nan=False)


def test_the_same_cloud_gives_the_same_answer(estimator: PoseEstimator, make_cloud: MakeCloud) -> None:
    first, second = (estimator.estimate(make_cloud()).to_dict()["poses"] for _ in range(2))
    assert first == second


def test_a_bundle_can_be_given_as_folder_text_or_loaded(
    bundle_folder: Path, trusted_key: Path, make_cloud: MakeCloud, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("ATTENTIONVOTE_KEYS", str(trusted_key.parent))
    digests = set()
    for bundle in (bundle_folder, str(bundle_folder), load_bundle(bundle_folder, trusted_key)):
        with PoseEstimator(bundle) as estimator:
            digests.add(estimator.digest)
            assert estimator.card.part.name == "bracket"
            assert isinstance(estimator.estimate(make_cloud()), Estimate)
    assert len(digests) == 1
    monkeypatch.setenv("ATTENTIONVOTE_KEYS", str(tmp_path))
    with pytest.raises(BundleError, match=r"signing\.pub must be a public key, but it cannot be read"):
        PoseEstimator(bundle_folder)
    PoseEstimator(bundle_folder, trusted=None).close()


def test_a_graph_that_is_not_its_cards_is_found(make_bundle: MakeBundle, trusted_key: Path) -> None:
    def change(folder: Path) -> None:
        import onnx

        model = onnx.load(folder / "model.onnx")
        model.graph.input[0].type.tensor_type.shape.dim[1].dim_value = 128
        onnx.save(model, folder / "model.onnx")

    with pytest.raises(BundleError, match=r"input points as tensor\(float\) of shape \(1, 256, 3\)"):
        PoseEstimator(make_bundle(change=change), trusted=trusted_key)


def test_an_empty_bin_is_an_answer(estimator: PoseEstimator, make_cloud: MakeCloud) -> None:
    for cloud, given in ((np.zeros((0, 3), np.float32), 0), (make_cloud(10), 10), (np.full((4, 5, 3), np.nan), 20)):
        answer = estimator.estimate(cloud)
        assert isinstance(answer, Abstention)
        assert answer.reason == "too_few_points"
        assert "at least 30 are needed" in answer.message
        assert answer.points_given == given
        assert answer.points_used == given % 20
        json.dumps(answer.to_dict(), allow_nan=False)


@pytest.mark.parametrize("graph", [{"heat": (0.3, 0, 0, 0)}, {"confidence": (0.4, 0.4, 0, 0)}, {"heat": (0,) * 4}])
def test_nothing_above_the_thresholds_is_an_answer(
    make_bundle: MakeBundle, trusted_key: Path, make_cloud: MakeCloud, graph: dict[str, Any]
) -> None:
    with PoseEstimator(make_bundle(graph=graph), trusted=trusted_key) as estimator:
        answer = estimator.estimate(make_cloud())
    assert isinstance(answer, Abstention)
    assert answer.reason == "nothing_found"
    assert answer.message == "no proposal reached the thresholds (heat 0.4, confidence 0.5)"


def test_a_deadline_is_an_answer_in_time(make_bundle: MakeBundle, trusted_key: Path, make_cloud: MakeCloud) -> None:
    with PoseEstimator(make_bundle(graph={"loops": 200_000_000}), trusted=trusted_key) as estimator:
        start = time.monotonic()
        answer = estimator.estimate(make_cloud(), deadline_s=0.3)
        assert 0.3 <= time.monotonic() - start < 2
    assert isinstance(answer, Abstention)
    assert answer.reason == "deadline_exceeded"
    assert answer.message == "the deadline of 0.3 s passed before there was an answer"
    assert answer.points_used == 3000
    assert set(answer.seconds) == {"read", "prepare", "total"}


def test_a_deadline_that_has_passed_stops_before_the_next_step(estimator: PoseEstimator, make_cloud: MakeCloud) -> None:
    answer = estimator.estimate(make_cloud(), deadline_s=0)
    assert isinstance(answer, Abstention)
    assert answer.reason == "deadline_exceeded"
    assert set(answer.seconds) == {"read", "total"}
    assert answer.points_given == 3000
    assert isinstance(estimator.estimate(make_cloud(), deadline_s=600), Estimate)
    for deadline_s in (-1.0, float("nan")):
        with pytest.raises(InputError, match="deadline_s must be seconds of at least 0"):
            estimator.estimate(make_cloud(), deadline_s=deadline_s)


def test_a_depth_image_gives_what_its_points_give(estimator: PoseEstimator) -> None:
    rng = np.random.default_rng(0)
    depth = (800 + 10 * rng.random((60, 80))).astype(np.uint16)
    depth[:10] = 0
    camera = CameraIntrinsics(fx=300, fy=300, cx=40, cy=30)
    image, points = estimator.estimate(depth=depth, camera=camera), estimator.estimate(camera.points(depth))
    assert image.to_dict()["poses"] == points.to_dict()["poses"]
    assert (image.points_given, image.points_used) == (4800, 4000)
    with pytest.raises(InputError, match=r"centimetres .*\(a depth image: depth_scale and depth_offset of its camera"):
        estimator.estimate(depth=depth, camera=CameraIntrinsics(300, 300, 40, 30, depth_scale=0.1))


def test_exactly_one_kind_of_input(estimator: PoseEstimator, make_cloud: MakeCloud) -> None:
    depth, camera = np.ones((5, 5)), CameraIntrinsics(300, 300, 2, 2)
    with pytest.raises(InputError, match="needs either points or a depth image with its camera, got neither"):
        estimator.estimate()
    with pytest.raises(InputError, match="got both"):
        estimator.estimate(make_cloud(), depth=depth, camera=camera)
    with pytest.raises(InputError, match="a depth image needs its camera, got none"):
        estimator.estimate(depth=depth)
    with pytest.raises(InputError, match="a camera belongs to a depth image"):
        estimator.estimate(make_cloud(), camera=camera)
    with pytest.raises(InputError, match=r"must be an array \(P, 3\), .*, got list"):
        estimator.estimate([[1, 2], [3]])  # type: ignore[arg-type]


def test_the_crop_decides_what_is_seen_and_golden_clouds_have_none(
    bundle_folder: Path, trusted_key: Path, make_cloud: MakeCloud
) -> None:
    inside = make_cloud(center=(0, 0, 0.8))
    hall = make_cloud(9000, seed=1, center=(0.5, 0, 3.0))
    with (
        PoseEstimator(bundle_folder, trusted=trusted_key, crop=CROP) as cropping,
        PoseEstimator(bundle_folder, trusted=trusted_key) as plain,
    ):
        seen = cropping.estimate(np.concatenate([hall, inside]))
        assert (seen.points_given, seen.points_used) == (12_000, 3000)
        assert seen.to_dict()["poses"] == plain.estimate(inside).to_dict()["poses"]
        outside = make_cloud(center=(0.5, 0, 0.8))
        assert isinstance(cropping.estimate(outside), Abstention)
        assert cropping.estimate_parts_only(outside).to_dict()["poses"] == plain.estimate(outside).to_dict()["poses"]


def test_an_unusual_cloud_is_answered_with_a_warning(estimator: PoseEstimator, make_cloud: MakeCloud) -> None:
    answer = estimator.estimate(make_cloud(center=(0, 0, 1.8)))
    assert isinstance(answer, Estimate)
    assert len(answer.warnings) == 1
    assert "lies farther than trained" in answer.warnings[0]


def test_poses_that_are_none_are_left_out_and_said(
    make_bundle: MakeBundle, trusted_key: Path, make_cloud: MakeCloud
) -> None:
    broken = ((0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    with PoseEstimator(make_bundle(graph={"quaternions": broken}), trusted=trusted_key) as estimator:
        answer = estimator.estimate(make_cloud())
    assert isinstance(answer, Estimate)
    assert [round(d.confidence, 3) for d in answer.detections] == [0.95]
    assert answer.warnings == (LEFT_OUT,)
    assert answer.poses_withheld == 1


def test_a_pose_outside_the_scan_is_left_out_and_counted(
    make_bundle: MakeBundle, trusted_key: Path, make_cloud: MakeCloud
) -> None:
    far = ((0.0, 0.0, 0.0), (1e29, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    with PoseEstimator(make_bundle(graph={"offsets": far}), trusted=trusted_key) as estimator:
        answer = estimator.estimate(make_cloud())
    assert isinstance(answer, Estimate)
    assert [round(d.confidence, 3) for d in answer.detections] == [0.7]
    assert answer.warnings == (LEFT_OUT,)
    assert answer.to_dict()["poses_withheld"] == 1


@pytest.mark.parametrize("far", [10.5, 1e8, 1e30, 3.4e38])
def test_strays_change_nothing_but_the_warning(estimator: PoseEstimator, make_cloud: MakeCloud, far: float) -> None:
    """Points that a sensor invents, in less than one of a hundred places."""
    cloud = make_cloud()
    strays = np.float32([[far, far, far], [-far, far, 0.8]]).repeat(10, axis=0)
    answer = estimator.estimate(np.concatenate([cloud, strays, np.full((80, 3), np.nan, np.float32)]))
    assert answer.to_dict()["poses"] == estimator.estimate(cloud).to_dict()["poses"]
    assert answer.warnings == ("20 points farther than 10 m were left out",)
    assert (answer.points_given, answer.points_measured, answer.points_used) == (3100, 3020, 3000)


def test_a_blind_sensor_is_no_empty_bin(bundle_folder: Path, trusted_key: Path) -> None:
    rng = np.random.default_rng(0)
    floor = np.c_[rng.uniform(-0.14, 0.14, 3000), rng.uniform(-0.09, 0.09, 3000), np.full(3000, 0.85)]
    blind = np.where(rng.random((3000, 1)) < 0.05, floor, np.nan)
    with PoseEstimator(bundle_folder, trusted=trusted_key, crop=CROP) as estimator:
        empty, unseen = estimator.estimate(floor.astype(np.float32)), estimator.estimate(blind.astype(np.float32))
    assert isinstance(empty, Abstention)
    assert isinstance(unseen, Abstention)
    assert (empty.reason, unseen.reason) == ("too_few_points", "blind_sensor")
    assert (unseen.points_given, unseen.points_measured) == (3000, np.isfinite(blind[:, 0]).sum())
    assert "is the sensor covered" in unseen.message


def test_a_scan_that_is_mostly_missing_is_answered_with_a_warning(
    estimator: PoseEstimator, make_cloud: MakeCloud
) -> None:
    cloud = make_cloud(3000)
    answer = estimator.estimate(np.concatenate([cloud, np.full((57_000, 3), np.nan, np.float32)]))
    assert answer.warnings == ("only 3000 of 60000 places have a measurement",)


def test_a_closed_estimator_says_so(estimator: PoseEstimator, make_cloud: MakeCloud) -> None:
    estimator.close()
    estimator.close()
    with pytest.raises(RuntimeError, match="the estimator is closed"):
        estimator.estimate(make_cloud())


def test_closing_lets_runs_end_that_have_begun(
    make_bundle: MakeBundle, trusted_key: Path, make_cloud: MakeCloud
) -> None:
    estimator = PoseEstimator(make_bundle(graph={"loops": 200_000}), trusted=trusted_key)
    answers: list[Estimate | Abstention] = []
    thread = threading.Thread(target=lambda: answers.append(estimator.estimate(make_cloud())))
    thread.start()
    time.sleep(0.05)
    estimator.close()
    thread.join()
    assert isinstance(answers[0], Estimate)


def test_estimates_side_by_side_are_those_made_alone(
    make_bundle: MakeBundle, trusted_key: Path, make_cloud: MakeCloud
) -> None:
    with PoseEstimator(make_bundle(graph={"loops": 5000}), trusted=trusted_key) as estimator:
        alone = [estimator.estimate(make_cloud(seed=seed)).to_dict()["poses"] for seed in range(4)]
        together: list[Any] = [None] * 4

        def work(seed: int) -> None:
            together[seed] = [estimator.estimate(make_cloud(seed=seed)).to_dict()["poses"] for _ in range(5)]

        threads = [threading.Thread(target=work, args=[seed]) for seed in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert together == [[poses] * 5 for poses in alone]


def test_threads_must_be_some(bundle_folder: Path, trusted_key: Path) -> None:
    with pytest.raises(ValueError, match="threads must be at least 1, got 0"):
        PoseEstimator(bundle_folder, threads=0, trusted=trusted_key)
