"""Point clouds of the sensor presets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.geometry.pose import transform
from attentionvote.part import Part
from attentionvote.scene import Scene
from attentionvote.simulation.raycast import PartCaster
from attentionvote.simulation.scene_record import SceneRecord
from attentionvote.simulation.sensor import CorrelatedNoise, Sensor, synthesize

Records = Callable[..., SceneRecord]
ALL = 10**6
# Every effect of the scanner off: one by one they are switched on.
QUIET = Sensor(
    "phoxi", axial_sigma_mm=0, grazing_degrees=(89.99, 90), baseline=0, edge_dropout=0, edge_flying=0, dropout=0
)


def cloud(record: SceneRecord, caster: PartCaster, sensor: Sensor, count: int = ALL, seed: int = 0) -> Scene:
    return synthesize(record, caster, sensor, count, np.random.default_rng(seed))


def pixels_of(record: SceneRecord, scene: Scene) -> np.ndarray:
    return np.round(record.camera.project(scene.points)).astype(int)


def test_exact_points_lie_on_their_parts(
    bracket: Part, caster: PartCaster, scene_record: Records, slow: SimpleNamespace
) -> None:
    record = scene_record(6)
    scene = cloud(record, caster, Sensor(), 3000)
    assert len(scene.points) == 3000
    assert scene.points.dtype == np.float32
    assert scene.normals is None
    for i, triangles in enumerate(slow.posed(bracket, record.camera_from_part)):
        own = scene.points[scene.instance_ids == i].astype(np.float64)
        assert slow.distance(own, triangles).max(initial=0) < 1e-5
    np.testing.assert_array_equal(scene.camera_from_part, record.camera_from_part)
    np.testing.assert_array_equal(scene.visible_fraction, record.visible_fraction)


def test_points_sit_on_different_pixels_and_cover_what_is_visible(caster: PartCaster, scene_record: Records) -> None:
    record = scene_record(6)
    scene = cloud(record, caster, Sensor())
    pixels = pixels_of(record, scene)
    np.testing.assert_allclose(record.camera.project(scene.points), pixels, atol=1e-3)
    assert len(np.unique(pixels, axis=0)) == len(pixels)
    v, u = np.mgrid[0 : record.camera.height, 0 : record.camera.width]
    rays = record.camera.rays(np.stack([u.ravel(), v.ravel()], axis=1))
    truth = caster.cast(record.camera_from_part, rays, record.bin_surface)
    assert len(scene.points) == (truth.instance >= 0).sum()
    image = truth.instance.reshape(v.shape)
    np.testing.assert_array_equal(scene.instance_ids, image[pixels[:, 1], pixels[:, 0]])


@pytest.mark.parametrize("preset", ["none", "gaussian", "phoxi"])
def test_same_rng_same_cloud_and_random_order(caster: PartCaster, scene_record: Records, preset: str) -> None:
    record, sensor = scene_record(6), Sensor(preset)
    a, b, c = (cloud(record, caster, sensor, 2000, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(a.points, b.points)
    assert not np.array_equal(a.points, c.points)
    # Any prefix is a sample of the whole: parts appear in the first quarter as often as in the rest.
    first = np.bincount(a.instance_ids[:500], minlength=6) / 500
    whole = np.bincount(a.instance_ids, minlength=6) / 2000
    np.testing.assert_allclose(first, whole, atol=0.07)
    correlation = np.corrcoef(np.arange(len(a.points)), a.points[:, 0])[0, 1]
    assert abs(correlation) < 0.08


def test_gaussian_noise_has_the_asked_for_spread(caster: PartCaster, scene_record: Records) -> None:
    record = scene_record(6)
    exact, noisy = cloud(record, caster, Sensor()), cloud(record, caster, Sensor("gaussian", sigma_mm=0.7))
    difference = noisy.points.astype(np.float64) - exact.points
    np.testing.assert_allclose(difference.std(axis=0), 0.0007, rtol=0.05)
    np.testing.assert_allclose(difference.mean(axis=0), 0, atol=3e-5)


def test_a_scanner_without_effects_is_exact(caster: PartCaster, scene_record: Records) -> None:
    record = scene_record(6)
    exact, scan = cloud(record, caster, Sensor()), cloud(record, caster, QUIET)
    missing = len(exact.points) - len(scan.points)
    assert 0 <= missing < 0.005 * len(exact.points)  # only what is seen at more than 89.99 degrees
    assert set(map(tuple, pixels_of(record, scan))) <= set(map(tuple, pixels_of(record, exact)))


def test_dropout_is_the_share_that_is_lost(caster: PartCaster, scene_record: Records) -> None:
    record = scene_record(6)
    full = len(cloud(record, caster, QUIET).points)
    assert len(cloud(record, caster, replace(QUIET, dropout=0.3)).points) == pytest.approx(0.7 * full, rel=0.03)


def test_axial_noise_grows_with_incidence_and_moves_along_the_ray(caster: PartCaster, scene_record: Records) -> None:
    record = scene_record(6)
    scan = cloud(record, caster, replace(QUIET, axial_sigma_mm=2.0))
    pixels = pixels_of(record, scan)
    np.testing.assert_allclose(record.camera.project(scan.points), pixels, atol=2e-3)  # still on its ray
    hits = caster.cast(record.camera_from_part, record.camera.rays(pixels), record.bin_surface)
    ray = np.c_[record.camera.rays(pixels), np.ones(len(pixels))]
    cosine = -np.einsum("pi,pi->p", hits.normal, ray) / np.linalg.norm(ray, axis=1)
    expected = 0.002 * (hits.depth / 0.65) ** 2 / np.maximum(cosine, 0.2)
    scaled = (scan.points[:, 2] - hits.depth) / expected
    for some in (cosine > 0.8, (cosine > 0.3) & (cosine < 0.6)):
        assert scaled[some].std() == pytest.approx(1, abs=0.05)


def test_grazing_surfaces_are_lost(caster: PartCaster, scene_record: Records) -> None:
    record = scene_record(6)
    scan = cloud(record, caster, replace(QUIET, grazing_degrees=(50, 60)))
    full = cloud(record, caster, QUIET)

    def incidence(scene: Scene) -> np.ndarray:
        rays = record.camera.rays(pixels_of(record, scene))
        hits = caster.cast(record.camera_from_part, rays, record.bin_surface)
        ray = np.c_[rays, np.ones(len(rays))]
        return np.degrees(np.arccos(-np.einsum("pi,pi->p", hits.normal, ray) / np.linalg.norm(ray, axis=1)))

    kept, there = incidence(scan), incidence(full)
    assert kept.max() <= 60.01
    assert (kept < 50).sum() == (there < 50).sum()
    ramp = [((a > 54) & (a < 56)).sum() for a in (kept, there)]
    assert ramp[0] == pytest.approx(0.5 * ramp[1], rel=0.2)


def test_what_the_projector_does_not_see_is_lost(
    bracket: Part, caster: PartCaster, scene_record: Records, slow: SimpleNamespace
) -> None:
    record = scene_record(6)
    full, scan = cloud(record, caster, QUIET), cloud(record, caster, replace(QUIET, baseline=0.27))
    kept = set(map(tuple, pixels_of(record, scan)))
    lost = np.array([tuple(p) not in kept for p in pixels_of(record, full)])
    assert 0.05 < lost.mean() < 0.6
    points = full.points.astype(np.float64)[::7]
    triangles = slow.posed(bracket, record.camera_from_part).reshape(-1, 3, 3)
    agreements = []
    for side in (-1.0, 1.0):  # which side is drawn at random
        projector = np.array([side * 0.27 * 0.48 / 0.80, 0, 0])
        hit, _ = slow.cast(projector, points - projector, triangles)
        depth = (points - projector)[:, 2]
        reach = record.bin_surface.moved(projector).depth((points - projector)[:, :2] / depth[:, None])
        agreements.append((((hit * depth < depth - 3e-4) | (reach < depth - 1e-3)) == lost[::7]).mean())
    # The rest faces away from the projector by more than 90 degrees, or by the margin.
    assert max(agreements) > 0.97


def test_edges_lose_points_and_grow_flying_ones(caster: PartCaster, scene_record: Records) -> None:
    record = scene_record(6)
    full = cloud(record, caster, QUIET)
    torn = cloud(record, caster, replace(QUIET, edge_dropout=1.0))
    lost_share = 1 - len(torn.points) / len(full.points)
    assert 0.02 < lost_share < 0.3
    half = cloud(record, caster, replace(QUIET, edge_dropout=0.5))
    assert 1 - len(half.points) / len(full.points) == pytest.approx(lost_share / 2, rel=0.15)
    # Nothing is left beside a depth jump.
    pixels = pixels_of(record, torn)
    depth = torn.points[:, 2]
    for step in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        beside = caster.cast(record.camera_from_part, record.camera.rays(pixels + step), record.bin_surface).depth
        assert np.abs(beside - depth).max() <= 0.003 * 0.48 / 0.80 + 1e-6
    flying = cloud(record, caster, replace(QUIET, edge_flying=1.0))
    assert len(flying.points) == len(full.points)
    hits = caster.cast(record.camera_from_part, record.camera.rays(pixels_of(record, flying)), record.bin_surface)
    moved = np.abs(flying.points[:, 2] - hits.depth) > 1e-6
    assert moved.mean() == pytest.approx(lost_share, rel=0.1)


def test_glare_takes_mirror_directions_only(caster: PartCaster, scene_record: Records) -> None:
    record = scene_record(1)
    # Facing the camera, seen along its normal: with the projector beside the camera this is the mirror direction.
    flat = replace(record, camera_from_part=transform(np.diag([1.0, -1.0, -1.0]), (0, 0, 0.42))[None])
    assert len(cloud(flat, caster, replace(QUIET, specular=1.0)).points) < 0.5 * len(cloud(flat, caster, QUIET).points)


def test_the_default_scanner_loses_a_plausible_share(caster: PartCaster, scene_record: Records) -> None:
    record = scene_record(8, seed=2)
    share = len(cloud(record, caster, Sensor("phoxi")).points) / len(cloud(record, caster, Sensor()).points)
    assert 0.5 < share < 0.95


def test_lengths_of_a_device_do_not_scale_with_the_distance(caster: PartCaster, scene_record: Records) -> None:
    """At half of 0.80 m a scaled baseline is half as long: its shadows are those of a device with half the baseline."""
    record = scene_record(8)
    half = float(record.camera_from_bin[2, 3]) / 0.8
    shadow = replace(QUIET, baseline=0.2)
    fixed = cloud(record, caster, replace(shadow, scaled=False))
    np.testing.assert_array_equal(
        fixed.points, cloud(record, caster, replace(QUIET, baseline=0.2 / half, edge_jump=0.003 / half)).points
    )
    assert len(fixed.points) < len(cloud(record, caster, shadow).points)


@given(st.floats(1.5, 20), st.integers(0, 100))
def test_correlated_noise_has_variance_one_and_fades_over_its_length(spacing: float, seed: int) -> None:
    pixels = np.stack(np.meshgrid(np.arange(200), np.arange(150)), axis=2).reshape(-1, 2).astype(np.int32)
    picture = CorrelatedNoise(200, 150, spacing, np.random.default_rng(seed))
    noise = picture(pixels).reshape(150, 200)
    cells = 150 * 200 / spacing**2
    assert abs(noise.var() - 1) < 6 / np.sqrt(cells)
    beside = (noise[:, 1:] * noise[:, :-1]).mean() / noise.var()
    far = round(2.2 * spacing)
    away = (noise[:, far:] * noise[:, :-far]).mean() / noise.var()
    assert beside > 1 - 1.2 / spacing
    assert abs(away) < 6 / np.sqrt(cells)
    # Any order of the pixels, any few of them: a scene is measured in batches.
    some = np.random.default_rng(0).permutation(len(pixels))[:500]
    np.testing.assert_array_equal(picture(pixels[some]), noise.ravel()[some])
    assert picture(pixels[:0]).shape == (0,)


def test_noise_of_a_stereo_camera_is_alike_beside(caster: PartCaster, scene_record: Records) -> None:
    record = scene_record(3)
    exact = cloud(record, caster, QUIET)
    at = pixels_of(record, exact)
    truth = dict(zip(map(tuple, at), exact.points[:, 2], strict=True))

    def between_neighbours(sensor: Sensor) -> float:
        scene = cloud(record, caster, sensor)
        error = {
            tuple(p): z - truth[tuple(p)] for p, z in zip(pixels_of(record, scene), scene.points[:, 2], strict=True)
        }
        pairs = np.array([(e, error[u + 1, v]) for (u, v), e in error.items() if (u + 1, v) in error])
        return float(np.corrcoef(pairs.T)[0, 1])

    noisy = replace(QUIET, axial_sigma_mm=0.1)
    assert abs(between_neighbours(noisy)) < 0.1
    assert between_neighbours(replace(noisy, noise_pixels=8)) > 0.6


def test_a_scene_outside_the_picture_is_empty(caster: PartCaster, scene_record: Records) -> None:
    record = scene_record(2)
    away = replace(record, camera_from_part=transform(np.eye(3), [[3.0, 0, 0.4], [3, 1, 0.5]]))
    for preset in ("none", "gaussian", "phoxi"):
        assert cloud(away, caster, Sensor(preset)).points.shape == (0, 3)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"preset": "fotoxi"},
            "preset must be one of none, gaussian, phoxi; got 'fotoxi', did you mean 'phoxi'",
        ),
        ({"preset": "gausian"}, "did you mean 'gaussian'"),
        ({"sigma_mm": -1}, "^sigma_mm must be at least 0 and at most 100; got -1"),
        ({"sigma_mm": float("nan")}, "^sigma_mm must be at least 0 and at most 100; got nan"),
        ({"edge_jump": 0}, "^edge_jump must be greater than 0 and at most 1; got 0"),
        ({"dropout": 1.5}, r"^dropout must be at least 0 and at most 1; got 1.5"),
        ({"edge_dropout": 0.8, "edge_flying": 0.3}, r"edge_dropout \+ edge_flying must be at most 1, got 1.1"),
        ({"grazing_degrees": (80, 70)}, "sensor grazing_degrees must be a range within 0..90"),
    ],
)
def test_impossible_sensors(settings: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Sensor(**settings)


def test_no_points_is_not_a_request(caster: PartCaster, scene_record: Records) -> None:
    with pytest.raises(ValueError, match="max_points must be at least 1, got 0"):
        cloud(scene_record(1), caster, Sensor(), 0)
