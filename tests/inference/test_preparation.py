"""Preparation: what training did, nothing else; every cloud that is none is one sentence."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.geometry import native
from attentionvote.geometry.pointcloud import estimate_normals
from attentionvote.geometry.pose import rotation_about, transform
from attentionvote.geometry.sampling import farthest_point_order
from attentionvote.inference import preparation
from attentionvote.inference.errors import InputError
from attentionvote.inference.measured_points import measured_points
from attentionvote.inference.preparation import (
    Crop,
    Prepared,
    TooFewPoints,
    fewest_points,
    find_neighbors,
)
from attentionvote.inference.scans.depth_files import CameraIntrinsics, read_depth

MakeCard = Callable[..., ModelCard]
MakeCloud = Callable[..., NDArray[np.float32]]


def prepare(points: NDArray, card: ModelCard, *arguments: Any, **named: Any) -> Prepared:
    """The inputs of a cloud's measured points."""
    return preparation.prepare(measured_points(points, card), card, *arguments, **named)


def overhead(height: float = 0.85, size: tuple[float, float, float] = (0.3, 0.2, 0.1), margin: float = 0.002) -> Crop:
    """A bin straight below a camera that looks down, its z towards the camera."""
    return Crop(transform(rotation_about([1, 0, 0], np.pi), [0, 0, height]), np.array(size), margin)


def rows(cloud: NDArray) -> set[bytes]:
    """Points as a set."""
    return {row.tobytes() for row in np.ascontiguousarray(cloud.reshape(-1, 3))}


LAYOUT = {"centers": [40, 20, 10, 5], "neighbors": [8, 6, 4, 2], "radii": [0.02, 0.04, 0.06, 0.12]}


def test_neighbours_are_found_by_c_code_or_not_at_all(make_cloud: MakeCloud, monkeypatch: pytest.MonkeyPatch) -> None:
    points = make_cloud(300)[None]
    assert native.load("attentionvote.geometry", "pointops.c") is not None  # as a cell's image does beforehand
    order, *neighbors = find_neighbors(points, LAYOUT)
    np.testing.assert_array_equal(order, farthest_point_order(points[0], 40))
    assert [one.shape for one in neighbors] == [(40, 8), (20, 6), (10, 4), (5, 2)]
    assert find_neighbors(points, None) == []  # a graph of an earlier version
    monkeypatch.setattr(native, "load", lambda *_, **__: None)  # a cell compiles nothing
    assert find_neighbors(points, LAYOUT) == []


def test_inputs_are_points_of_the_cloud_with_the_dense_clouds_normals(
    make_card: MakeCard, make_cloud: MakeCloud
) -> None:
    card, cloud = make_card(density=5000), make_cloud()
    prepared = prepare(cloud, card)
    assert prepared.points.shape == prepared.normals.shape == (1, 256, 3)
    assert prepared.points.dtype == prepared.normals.dtype == np.float32
    assert prepared.points.flags.c_contiguous
    assert len(rows(prepared.points)) == 256
    assert rows(prepared.points) <= rows(cloud)
    np.testing.assert_allclose(prepared.normals[0], estimate_normals(cloud, prepared.points[0], 30), atol=1e-5)
    assert (prepared.used, prepared.warnings) == (3000, ())


def test_more_points_than_the_density_are_thinned_before_the_normals(
    make_card: MakeCard, make_cloud: MakeCloud
) -> None:
    cloud = make_cloud(3000)
    thin, whole = (prepare(cloud, make_card(density=density)) for density in (300, 5000))
    # On a tenth of the points the same 30 neighbours reach three times as far: other normals.
    assert len(rows(thin.points)) == 256
    reach = estimate_normals(cloud, thin.points[0], 30)
    assert np.degrees(np.arccos(np.clip((reach * thin.normals[0]).sum(1), -1, 1))).mean() > 3
    np.testing.assert_allclose(estimate_normals(cloud, whole.points[0], 30), whole.normals[0], atol=1e-6)


def test_the_same_cloud_gives_the_same_inputs(make_card: MakeCard, make_cloud: MakeCloud) -> None:
    first, second = (prepare(make_cloud(), make_card()) for _ in range(2))
    np.testing.assert_array_equal(first.points, second.points)
    np.testing.assert_array_equal(first.normals, second.normals)
    other = prepare(make_cloud(), make_card(), seed=1)
    assert not np.array_equal(first.points, other.points)


def test_points_that_occur_many_times_are_no_trouble(make_card: MakeCard, make_cloud: MakeCloud) -> None:
    twice = np.repeat(make_cloud(500), 4, axis=0)
    first, second = (prepare(twice, make_card()) for _ in range(2))
    np.testing.assert_array_equal(first.normals, second.normals)
    one = np.tile(np.float32([[0, 0, 0.8]]), (100, 1))
    assert np.isfinite(prepare(one, make_card()).normals).all()


def test_a_small_cloud_is_repeated_to_fill_the_input(make_card: MakeCard, make_cloud: MakeCloud) -> None:
    cloud = make_cloud(100)
    prepared = prepare(cloud, make_card())
    assert rows(prepared.points) == rows(cloud)


def test_the_camera_may_see_more_than_the_bin(make_card: MakeCard, make_cloud: MakeCloud) -> None:
    crop = overhead()
    rng = np.random.default_rng(1)
    inside = make_cloud(center=(0, 0, 0.8))
    floor = np.c_[rng.uniform(-0.15, 0.15, (2000, 2)), np.full(2000, 0.85)].astype(np.float32)
    hall = np.c_[rng.uniform(-3, 3, (9000, 2)), rng.uniform(2, 9, 9000)].astype(np.float32)
    kept = inside[crop.inside(inside)]
    prepared = prepare(np.concatenate([hall, floor, inside]), make_card(), crop)
    assert prepared.used == len(kept)
    assert rows(prepared.points) <= rows(kept)


def test_too_few_points_are_an_answer_about_the_bin(make_card: MakeCard, make_cloud: MakeCloud) -> None:
    card = make_card()
    assert fewest_points(card) == 30
    prepare(make_cloud(30), card)
    for count in (0, 1, 29):
        with pytest.raises(TooFewPoints, match=f"^{count} points were measured, at least 30 are needed") as caught:
            prepare(make_cloud(count), card)
        assert caught.value.used == count
    with pytest.raises(TooFewPoints, match=r"^0 points are left in the bin of 3000 measured, at least 30"):
        prepare(make_cloud(), card, overhead(height=2.0))
    assert fewest_points(make_card(normal_neighbors=1)) == 3


def test_with_fewer_points_than_neighbours_all_normals_are_one(make_card: MakeCard, make_cloud: MakeCloud) -> None:
    # Why there is a least number: from there on normals say nothing about the shape.
    few = make_cloud(20)
    normals = estimate_normals(few, few, 30)
    np.testing.assert_allclose(np.abs(normals @ normals[0]), 1, atol=1e-5)
    more = make_cloud(fewest_points(make_card()) * 20)
    assert np.abs(estimate_normals(more, more, 30) @ normals[0]).min() < 0.95


def test_millimetres_are_refused_also_when_the_crop_would_leave_nothing(
    make_card: MakeCard, make_cloud: MakeCloud
) -> None:
    for crop in (None, overhead()):
        with pytest.raises(InputError, match="were millimetres sent"):
            prepare(make_cloud() * np.float32(1000), make_card(), crop)


def test_the_callers_array_is_not_changed(make_card: MakeCard, make_cloud: MakeCloud) -> None:
    cloud = make_cloud()
    cloud.setflags(write=False)
    before = cloud.copy()
    prepare(cloud, make_card(), overhead())
    np.testing.assert_array_equal(cloud, before)
    prepare(cloud[::-1, ::-1][:, ::-1].astype(">f8"), make_card())


def test_what_is_called_between_the_steps_can_end_the_preparation(make_card: MakeCard, make_cloud: MakeCloud) -> None:
    def stop() -> None:
        raise KeyError("enough")

    with pytest.raises(KeyError, match="enough"):
        prepare(make_cloud(), make_card(), between=stop)


def test_a_real_frame_is_read_and_prepared(shared_data: Callable[[str], object], make_card: MakeCard) -> None:
    folder = shared_data("sileane_bunny_sample")
    words = dict(line.split(None, 1) for line in (folder / "camera_params.txt").read_text().splitlines())  # type: ignore[operator]
    near, far = float(words["clip_start"]), float(words["clip_end"])
    intrinsics = [float(words[name]) for name in ("fu", "fv", "cu", "cv")]
    camera = CameraIntrinsics(*intrinsics, (far - near) / 65535, near, 65535, 1296, 1024)
    depth = read_depth(folder / "depth.PNG")  # type: ignore[operator]
    points = camera.points(depth)
    # What is known of the frame: shared/data/README.md.
    assert len(points) == 925_936
    assert 0.772 < points[:, 2].min() < 0.773
    assert 0.925 < points[:, 2].max() < 0.926
    card = make_card(points=4096, density=40_000, distance=(0.7, 1.0), extent=0.3)
    prepared = prepare(points, card)
    assert prepared.warnings == ()
    assert prepared.used == 925_936
    np.testing.assert_allclose(np.linalg.norm(prepared.normals[0], axis=1), 1, atol=1e-5)
    assert ((prepared.normals[0] * prepared.points[0]).sum(1) <= 0).all()  # towards the camera
    # The same frame as a whole cloud, organised.
    image = np.full((1024, 1296, 3), np.nan, np.float32)
    image[depth != 65535] = points
    np.testing.assert_array_equal(prepare(image, card).points, prepared.points)
