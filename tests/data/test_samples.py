"""A sample is a random part of a cloud in rigid motion; a batch pads what differs."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.data.augmentation import Augmentation
from attentionvote.data.clouds import Clouds
from attentionvote.data.samples import Batch, collate, draw_sample
from attentionvote.geometry.pose import apply
from attentionvote.model.neighborhoods import Layout, find_neighborhoods
from attentionvote.scene import Scene


def equal(a: Batch, b: Batch) -> bool:
    plain = [name for name in Batch._fields if name != "neighborhoods"]
    same = all(torch.equal(getattr(a, name), getattr(b, name)) for name in plain)
    levels = [(a.neighborhoods.order, b.neighborhoods.order)]
    for name in ("neighbors", "nearest", "weights"):
        levels += list(zip(getattr(a.neighborhoods, name), getattr(b.neighborhoods, name), strict=True))
    return same and all(torch.equal(x, y) for x, y in levels)


@given(st.integers(0, 2**32 - 1), st.booleans(), st.floats(0, 0.5))
def test_augmentation_is_one_rigid_motion_of_everything(clouds: Clouds, seed: int, roll: bool, tilt: float) -> None:
    scene = clouds[3]
    assert scene.normals is not None
    points, normals, poses = Augmentation(roll, tilt).apply(
        scene.points, scene.normals, scene.camera_from_part, np.random.default_rng(seed)
    )
    # The motion, from the poses alone: it must also explain the points and the normals.
    motion = poses[0] @ np.linalg.inv(scene.camera_from_part[0])
    np.testing.assert_allclose(motion[:3, :3] @ motion[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(motion[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(poses, motion @ scene.camera_from_part, atol=1e-12)
    np.testing.assert_allclose(points, apply(motion, scene.points.astype(np.float64)), atol=1e-6)
    np.testing.assert_allclose(normals, scene.normals @ motion[:3, :3].T, atol=1e-6)
    # It stays before the camera. Both means in double precision: those of single precision were off by 8e-7, which the
    # order of summing decides; what the rounding of the points and of the motion moves is below 2e-7.
    np.testing.assert_allclose(points.mean(0, dtype=np.float64), scene.points.mean(0, dtype=np.float64), atol=1e-6)


def test_augmentation_can_be_off_and_can_add_noise(clouds: Clouds) -> None:
    scene, rng = clouds[3], np.random.default_rng(0)
    assert scene.normals is not None
    points, normals, poses = Augmentation(roll=False, tilt=0.0).apply(
        scene.points, scene.normals, scene.camera_from_part, rng
    )
    np.testing.assert_allclose(points, scene.points, atol=1e-7)
    np.testing.assert_allclose(poses, scene.camera_from_part, atol=1e-12)
    np.testing.assert_allclose(normals, scene.normals, atol=1e-7)
    noisy, same, truth = Augmentation(False, 0.0, jitter_mm=2.0).apply(
        scene.points, scene.normals, scene.camera_from_part, rng
    )
    assert np.std(noisy - scene.points) == pytest.approx(0.002, rel=0.1)
    # Noise after the normals (Table 4's other reading): they, and the truth, stay what they were.
    np.testing.assert_allclose(same, scene.normals, atol=1e-7)
    np.testing.assert_allclose(truth, scene.camera_from_part, atol=1e-12)


def test_a_sample_keeps_points_normals_and_instances_together(clouds: Clouds, layout: Layout) -> None:
    scene = clouds[4]
    assert scene.normals is not None
    sample = draw_sample(scene, 200, layout, None, np.random.default_rng(1))
    rows = [int(np.flatnonzero((scene.points == p).all(1))[0]) for p in sample.points.numpy()]
    assert len(set(rows)) == 200
    np.testing.assert_array_equal(sample.normals.numpy(), scene.normals[rows])
    np.testing.assert_array_equal(sample.instance.numpy(), scene.instance_ids[rows])
    np.testing.assert_array_equal(sample.rotation.numpy(), scene.camera_from_part[:, :3, :3].astype(np.float32))
    np.testing.assert_array_equal(sample.center.numpy(), scene.camera_from_part[:, :3, 3].astype(np.float32))
    np.testing.assert_array_equal(sample.visible.numpy(), scene.visible_fraction.astype(np.float32))
    assert torch.equal(sample.neighborhoods.order, find_neighborhoods(sample.points.numpy(), layout).order)


def test_moved_points_still_lie_on_their_own_instance(clouds: Clouds, layout: Layout) -> None:
    sample = draw_sample(clouds[4], 300, layout, Augmentation(), np.random.default_rng(2))
    own = sample.instance.long()
    in_part = torch.einsum("nji,nj->ni", sample.rotation[own], sample.points - sample.center[own])
    assert (in_part.abs() <= torch.tensor([0.03, 0.02, 0.01]) + 0.0015).all()  # five sigma of the noise


def test_a_small_cloud_is_sampled_with_repetition(clouds: Clouds, layout: Layout) -> None:
    scene = clouds[0]
    few = Scene(
        scene.points[:40], scene.instance_ids[:40], scene.camera_from_part, scene.visible_fraction, scene.part_ids,
        None if scene.normals is None else scene.normals[:40],
    )  # fmt: skip
    sample = draw_sample(few, 64, layout, None, np.random.default_rng(0))
    assert len(sample.points) == 64
    assert len(np.unique(sample.points.numpy(), axis=0)) == 40


def test_empty_clouds_and_missing_normals_are_refused(clouds: Clouds, layout: Layout) -> None:
    scene, rng = clouds[0], np.random.default_rng(0)
    bare = Scene(scene.points, scene.instance_ids, scene.camera_from_part, scene.visible_fraction, scene.part_ids)
    with pytest.raises(ValueError, match="must have normals"):
        draw_sample(bare, 64, layout, None, rng)
    none = np.zeros((0, 3), np.float32)
    empty = Scene(
        none, np.zeros(0, np.int32), scene.camera_from_part, scene.visible_fraction, scene.part_ids, none
    )  # fmt: skip
    with pytest.raises(ValueError, match="cannot sample from an empty cloud"):
        draw_sample(empty, 64, layout, None, rng)


def test_a_batch_pads_instances_that_nobody_takes_for_real(clouds: Clouds, layout: Layout) -> None:
    samples = [draw_sample(clouds[i], 64, layout, None, np.random.default_rng(i)) for i in (0, 3)]
    batch = collate(samples)
    assert batch.points.shape == (2, 64, 3)
    assert batch.center.shape == (2, 4, 3)
    assert torch.equal(batch.center[0, :1], samples[0].center)
    assert torch.equal(batch.center[0, 1:], torch.zeros(3, 3))
    assert torch.equal(batch.rotation[0, 1:], torch.eye(3).expand(3, 3, 3))
    assert torch.equal(batch.visible[0, 1:], torch.zeros(3))
    assert torch.equal(batch.rotation[1], samples[1].rotation)
    assert torch.equal(batch.neighborhoods.neighbors[2][1], samples[1].neighborhoods.neighbors[2])


def test_the_first_samples_of_a_batch_are_a_batch(clouds: Clouds, layout: Layout) -> None:
    samples = [draw_sample(clouds[3], 64, layout, None, np.random.default_rng(i)) for i in range(3)]
    assert equal(collate(samples).first(2), collate(samples[:2]))
    assert equal(collate(samples).to("cpu"), collate(samples))
