"""Scenes with several kinds of parts: what is dropped, what rays meet, what is stored; and that one part is as ever."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.geometry.pose import apply, transform
from attentionvote.part import Part, PartSet
from attentionvote.simulation import cycle, scene_set
from attentionvote.simulation.camera import Camera
from attentionvote.simulation.cycle import draw_part_ids, solids_of
from attentionvote.simulation.drop_settings import BinSettings
from attentionvote.simulation.part_files import load_part, load_parts
from attentionvote.simulation.raycast import BinSurface, PartCaster
from attentionvote.simulation.scene_record import SceneRecord, load_records, save_records
from attentionvote.simulation.scene_set import SceneSet, generate_scene_set
from attentionvote.simulation.scene_spec import SceneSetSpec
from attentionvote.simulation.scene_view import scene_figure
from attentionvote.simulation.sensor import Sensor, synthesize

CAMERA = Camera(160, 120, 250.0, 250.0, 80.0, 60.0)


@pytest.fixture(autouse=True)
def one_hull(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cycle, "convex_hulls", lambda part, *_, **__: (part.vertices,))


@pytest.fixture
def both(bracket: Part, box_and_slab: PartSet) -> PartSet:
    """The bracket and the slab."""
    return PartSet("both", (bracket, box_and_slab.parts[1]))


def spec_of(parts: Part | PartSet, cycles: int = 2, counts: tuple[int, ...] = (2, 4)) -> SceneSetSpec:
    camera = replace(SceneSetSpec(parts.digest, "train", 1).camera, camera=CAMERA)
    return SceneSetSpec(parts.digest, "train", cycles, 0, counts, camera=camera)


@given(st.integers(1, 6), st.integers(1, 30), st.integers(0, 99))
def test_every_kind_of_part_is_dropped_before_any_comes_again_by_chance(parts: int, count: int, seed: int) -> None:
    ids = draw_part_ids(parts, count, np.random.default_rng(seed))
    assert ids.shape == (count,)
    assert set(ids) <= set(range(parts))
    assert len(set(ids[:parts])) == min(parts, count)
    np.testing.assert_array_equal(ids, draw_part_ids(parts, count, np.random.default_rng(seed)))


def test_drops_of_all_kinds_come_equally_often() -> None:
    drawn = np.concatenate([draw_part_ids(3, 30, np.random.default_rng(i)) for i in range(200)])
    np.testing.assert_allclose(np.bincount(drawn) / len(drawn), 1 / 3, atol=0.02)


def test_a_generated_set_holds_all_kinds_at_rest_in_the_bin(both: PartSet, tmp_path: Path) -> None:
    scenes = generate_scene_set(both, spec_of(both), tmp_path / "set", progress=False)
    assert len(scenes) == 4
    for record in scenes:
        assert set(record.part_ids) == {0, 1}
        bin_from_part = np.linalg.inv(record.camera_from_bin) @ record.camera_from_part
        for kind, pose in zip(record.part_ids, bin_from_part, strict=True):
            corners = apply(pose, both.parts[kind].vertices)
            assert corners[:, 2].min() > -0.005 * both.diameter
            assert (np.abs(corners[:, :2]) < record.bin_size[:2] / 2 + 0.005 * both.diameter).all()
    # The kinds come from the cycle's own seed, and belong to the content.
    first, second = scenes.records[1].part_ids, scenes.records[3].part_ids
    np.testing.assert_array_equal(scenes.records[0].part_ids, first[:2])
    again = generate_scene_set(both, spec_of(both), tmp_path / "again", workers=2, progress=False)
    assert again.digest == scenes.digest
    assert len({tuple(first), tuple(second)} | {tuple(r.part_ids) for r in again}) >= 2


def test_the_frozen_pieces_are_read_again_part_by_part(both: PartSet, tmp_path: Path) -> None:
    spec = spec_of(both)
    made = scene_set._frozen_solids(both, spec, tmp_path)
    again = scene_set._frozen_solids(both, spec, tmp_path)
    for a, b, c in zip(made, again, solids_of(both, spec.drop), strict=True):
        assert a.part is b.part is c.part
        np.testing.assert_array_equal(np.concatenate(a.hulls), np.concatenate(b.hulls))
        np.testing.assert_array_equal(np.concatenate(a.hulls), np.concatenate(c.hulls))


def test_the_bin_fits_the_largest_part_and_the_mean_volume(both: PartSet, bracket: Part) -> None:
    assert BinSettings().scaling_diameter(both, 3) == both.diameter > bracket.diameter
    alone = [BinSettings().scaling_diameter(part, 150) for part in both.parts]
    assert min(alone) < BinSettings().scaling_diameter(both, 150) < max(alone)


def test_a_set_of_one_part_makes_the_scenes_of_the_part(bracket: Part, tmp_path: Path) -> None:
    alone = PartSet("alone", (bracket,))
    assert spec_of(alone).digest() == spec_of(bracket).digest()
    one = generate_scene_set(bracket, spec_of(bracket), tmp_path / "part", progress=False)
    other = generate_scene_set(alone, spec_of(alone), tmp_path / "set", progress=False)
    assert one.digest == other.digest
    assert not any(record.part_ids.any() for record in one)
    with np.load(tmp_path / "part" / "cycles" / "00000.npz") as stored:
        assert "part_ids" not in stored.files


def test_scene_sets_of_one_part_keep_their_digests() -> None:
    """Recorded before sets of several parts existed (commit 54fc2b9): stored scene sets must be found again."""
    rod = load_part("connecting_rod", "builtin:connecting_rod", 0.143)
    assert rod.digest == "dc3c1821f5dba106686d17277234c531470e84a56041101dcc5f9fb0cc0b1f6f"
    spec = SceneSetSpec(rod.digest, "test", 10)
    assert spec.digest() == "9dd330d0db7c7b2c918d81525561318fa04deaccbfb7451c32ea9295e69e202b"


def test_rays_meet_every_kind_as_brute_force_does(both: PartSet, heap: Callable, slow: SimpleNamespace) -> None:
    poses, ids = heap(6), np.array([0, 1, 1, 0, 1, 0], dtype=np.int32)
    caster, rng = PartCaster(both), np.random.default_rng(0)
    xy = rng.uniform(-0.2, 0.2, (400, 2))
    triangles = [slow.posed(both.parts[kind], pose[None])[0] for kind, pose in zip(ids, poses, strict=True)]
    owner = np.repeat(np.arange(6), [len(own) for own in triangles])
    surfaces = np.concatenate(triangles)
    depth, face = slow.cast(np.zeros(3), np.c_[xy, np.ones(len(xy))], surfaces)
    hits = caster.cast(poses, xy, part_ids=ids)
    met = np.isfinite(depth)
    assert 100 < met.sum() < 400
    np.testing.assert_array_equal(hits.instance, np.where(met, owner[face], -1))
    np.testing.assert_allclose(hits.depth[met], depth[met], rtol=1e-5)
    a, b, c = np.moveaxis(surfaces[face[met]], 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs((hits.normal[met] * normal).sum(1)), 1, atol=1e-6)


def test_what_is_seen_of_every_kind_is_counted_pixel_by_pixel(both: PartSet, heap: Callable) -> None:
    poses, ids = heap(5, seed=3), np.array([1, 0, 1, 0, 0], dtype=np.int32)
    caster = PartCaster(both)
    surface = BinSurface(np.array([0.3, 0.3, 0.2]), transform(np.diag([1.0, -1.0, -1.0]), (0.0, 0.0, 0.5)))
    v, u = np.mgrid[-200:400, -200:400]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    rays = CAMERA.rays(pixels)
    alone = [(caster.cast(poses[[i]], rays, part_ids=ids[[i]]).instance >= 0).sum() for i in range(5)]
    inside = ((pixels >= 0) & (pixels < [CAMERA.width, CAMERA.height])).all(axis=1)
    owner = caster.cast(poses, rays[inside], surface, ids).instance
    expected = np.bincount(owner[owner >= 0], minlength=5) / alone
    np.testing.assert_allclose(caster.visible_fraction(poses, CAMERA, surface, 1, ids), expected, atol=1e-9)
    u0, u1, v0, v1 = caster.pixel_box(poses, CAMERA, ids)
    seen = pixels[inside][owner >= 0]
    assert (seen >= [u0, v0]).all()
    assert (seen <= [u1, v1]).all()


def test_part_ids_are_stored_and_old_files_hold_the_first_part_only(
    scene_record: Callable[..., SceneRecord], tmp_path: Path
) -> None:
    mixed = [replace(scene_record(n), part_ids=np.arange(n, dtype=np.int32) % 3) for n in (2, 5)]
    save_records(tmp_path / "mixed.npz", mixed)
    for a, b in zip(mixed, load_records(tmp_path / "mixed.npz"), strict=True):
        np.testing.assert_array_equal(a.part_ids, b.part_ids)
        assert b.part_ids.dtype == np.int32
    save_records(tmp_path / "old.npz", [scene_record(4)])
    np.testing.assert_array_equal(load_records(tmp_path / "old.npz")[0].part_ids, np.zeros(4))


@pytest.mark.parametrize("preset", ["none", "phoxi"])
def test_a_measured_cloud_lies_on_the_parts_it_names(
    make_scenes: Callable[..., SceneSet], box_and_slab: PartSet, preset: str
) -> None:
    record = make_scenes((6,), parts=box_and_slab).records[0]
    np.testing.assert_array_equal(record.part_ids, [0, 1, 0, 1, 0, 1])
    sensor = Sensor(preset, edge_flying=0.0, axial_sigma_mm=0.0)
    cloud = synthesize(record, PartCaster(box_and_slab), sensor, 800, np.random.default_rng(0))
    np.testing.assert_array_equal(cloud.part_ids, record.part_ids)
    assert len(set(cloud.instance_ids)) > 3
    for i in set(cloud.instance_ids):
        local = apply(np.linalg.inv(record.camera_from_part[i]), cloud.points[cloud.instance_ids == i])
        high = box_and_slab.parts[record.part_ids[i]].box[1]
        assert (np.abs(local) <= high + 1e-5).all()
        np.testing.assert_allclose((np.abs(local) - high).max(axis=1), 0, atol=1e-5)


def test_a_scene_s_page_shows_every_part_with_its_own_mesh(
    make_scenes: Callable[..., SceneSet], box_and_slab: PartSet
) -> None:
    record = make_scenes((3,), parts=box_and_slab).records[0]
    scene = synthesize(record, PartCaster(box_and_slab), Sensor(), 300, np.random.default_rng(0))
    figure = scene_figure(box_and_slab, record, scene)
    mesh = next(trace for trace in figure.data if trace.type == "mesh3d")
    shown = np.c_[mesh.x, mesh.y, mesh.z]
    kinds = [box_and_slab.parts[k] for k in (0, 1, 0)]
    expected = np.concatenate([apply(p, k.vertices) for p, k in zip(record.camera_from_part, kinds, strict=True)])
    np.testing.assert_allclose(shown, expected, atol=1e-5)
    assert len(mesh.i) == sum(len(k.faces) for k in kinds)
    assert any(text.startswith("slab, instance 1") for text in figure.data[0].text)


def test_a_set_s_settings_are_those_of_its_parts(bracket: Part) -> None:
    rod = {"_target_": "load_part", "name": "rod", "mesh": "builtin:connecting_rod", "diameter": 0.143}
    both = load_parts("bin", {"rod": rod, "bracket": bracket}, "a bin")
    assert [part.name for part in both.parts] == ["rod", "bracket"]
    assert (both.name, both.title, both.diameter) == ("bin", "a bin", 0.143)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({}, "bin: parts must be at least two parts by name, got none"),
        (None, "bin: parts must be at least two parts by name, got None"),
        ({"rod": {"name": "rod", "mesh": "builtin:connecting_rod"}}, "at least two parts by name, got rod"),
        ({"a": {"name": "a", "mesh": "builtin:gear"}, "b": 3}, "parts.b must be the settings of one part, .* got 3"),
        ({"a": {"name": "a", "mesh": "builtin:gear"}, "b": {"name": "b"}}, "parts.b must be the settings of one part"),
        ({"a": {"name": "a", "mesh": "builtin:gear"}, "b": {"name": "b", "mesh": "b.stl"}}, "object 'b', b, must be"),
        ({k: {"name": k, "mesh": "builtin:gear"} for k in "ab"}, "bin: the parts of a set must differ, but a is b"),
    ],
)
def test_impossible_sets_are_refused(parts: object, message: str) -> None:
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        load_parts("bin", parts)  # type: ignore[arg-type]
