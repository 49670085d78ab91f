"""Drops: piles at rest inside the bin, and the guards."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from attentionvote.geometry.pose import apply
from attentionvote.part import Part
from attentionvote.simulation import drop
from attentionvote.simulation.decomposition import Hulls, convex_hulls
from attentionvote.simulation.drop import Solid, drop_parts
from attentionvote.simulation.drop_settings import BinSettings, DropSettings
from attentionvote.simulation.mass import mass_properties
from attentionvote.simulation.part_files import load_part

BIN = np.array([0.15, 0.12, 0.1])


def piles(part: Part, hulls: Hulls, count: int, bin_size: NDArray = BIN, seed: int = 0, **settings: object) -> list:
    rng = np.random.default_rng(seed)
    part_ids, physics = np.zeros(count, dtype=np.int32), DropSettings(**settings)  # type: ignore[arg-type]
    return list(drop_parts([Solid(part, hulls)], part_ids, bin_size, 0.4, physics, rng))


def test_every_drop_adds_a_part_that_rests_inside_the_bin(bracket: Part, hulls: Hulls) -> None:
    result = piles(bracket, hulls, 6)
    assert [len(p) for p in result] == [1, 2, 3, 4, 5, 6]
    margin = 0.005 * bracket.diameter
    for pile in result:
        rotation = pile[:, :3, :3]
        np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-9)
        vertices = apply(pile, bracket.vertices)
        assert vertices[..., 2].min() >= -margin
        assert (np.abs(vertices[..., :2]) <= BIN[:2] / 2 + margin).all()
    # The first part lies on the floor, it does not hover.
    assert apply(result[0], bracket.vertices)[..., 2].min() < margin


def test_same_seed_same_piles_other_seed_others(bracket: Part, hulls: Hulls) -> None:
    a, b, c = (piles(bracket, hulls, 2, seed=seed)[-1] for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert not np.allclose(a, c, atol=1e-3)


def test_fewer_drops_are_the_beginning_of_the_cycle(bracket: Part, hulls: Hulls) -> None:
    part_ids, rng = np.zeros(4, dtype=np.int32), np.random.default_rng(1)
    result = list(drop_parts([Solid(bracket, hulls)], part_ids, BIN, 0.4, DropSettings(), rng, drops=2))
    assert [len(pile) for pile in result] == [1, 2]
    np.testing.assert_array_equal(result[-1], piles(bracket, hulls, 4, seed=1)[1])


def test_a_full_bin_ends_the_cycle(bracket: Part, hulls: Hulls) -> None:
    low = np.array([0.08, 0.07, 0.03])
    result = piles(bracket, hulls, 12, bin_size=low)
    assert 0 < len(result) < 12
    centre = mass_properties(bracket)[1]
    assert all(apply(p, centre[None])[..., 2].max() <= low[2] for p in result)


def test_a_part_longer_than_the_bin_starts_in_its_middle(bracket: Part, hulls: Hulls) -> None:
    assert piles(bracket, hulls, 1, bin_size=np.array([0.05, 0.05, 0.2])) is not None


def test_a_moving_pile_is_left_out_and_the_cycle_goes_on(
    bracket: Part, hulls: Hulls, monkeypatch: pytest.MonkeyPatch
) -> None:
    settle, calls = drop._settle, []

    def restless(*args: object) -> float:
        calls.append(settle(*args))  # type: ignore[arg-type]
        return 0.051 if len(calls) == 2 else calls[-1]

    monkeypatch.setattr(drop, "_settle", restless)
    assert [len(p) for p in piles(bracket, hulls, 3)] == [1, 3]


@pytest.mark.parametrize("broken", ["nan_speed", "nan_pose", "outside", "below"])
def test_an_exploded_pile_ends_the_cycle(
    bracket: Part, hulls: Hulls, monkeypatch: pytest.MonkeyPatch, broken: str
) -> None:
    settle = drop._settle

    def explode(model: object, data: object, dropped: int, settings: DropSettings) -> float:
        speed = settle(model, data, dropped, settings)  # type: ignore[arg-type]
        if dropped == 2:
            if broken == "nan_speed":
                return float("nan")
            row, value = {"nan_pose": (3, np.nan), "outside": (0, 0.2), "below": (2, -0.1)}[broken]
            data.qpos[row] = value  # type: ignore[attr-defined]
        return speed

    monkeypatch.setattr(drop, "_settle", explode)
    assert [len(p) for p in piles(bracket, hulls, 3)] == [1]


def test_physics_settings_reach_the_model(bracket: Part, hulls: Hulls) -> None:
    mass, _, inertia = properties = mass_properties(bracket)
    solid, three = Solid(bracket, hulls), np.zeros(3, dtype=np.int32)
    volume = 0.06 * 0.02 * 0.008 + 0.008 * 0.02 * 0.032
    assert mass == pytest.approx(volume * 2700, rel=1e-6)
    model = drop._build_model([solid], [properties], three, BIN, 0.35, DropSettings())
    assert model.opt.timestep == 0.004
    assert (model.opt.iterations, model.opt.ls_iterations) == (100, 50)
    np.testing.assert_allclose(model.geom_friction, np.broadcast_to((0.35, 0.005, 0.0001), model.geom_friction.shape))
    np.testing.assert_allclose(model.geom_solref, np.broadcast_to((0.01, 1.0), model.geom_solref.shape))
    np.testing.assert_allclose(model.body_mass[1:], mass)
    np.testing.assert_allclose(sorted(model.body_inertia[1]), np.linalg.eigvalsh(inertia), rtol=1e-6)
    tiny = Solid(replace(bracket, diameter=0.039), hulls)
    small = drop._build_model([tiny], [properties], three[:1], BIN, 0.35, DropSettings())
    assert small.opt.timestep == 0.002
    assert small.geom_solref[0, 0] == 0.005


def test_the_bin_scales_with_the_part_and_varies() -> None:
    sizes = np.array([BinSettings().sample(0.143, np.random.default_rng(i)) for i in range(200)])
    ratio = sizes / (0.36, 0.28, 0.16)
    assert 0.85 <= ratio.min() < 0.87
    assert 1.13 < ratio.max() <= 1.15
    np.testing.assert_allclose(BinSettings(jitter=0).sample(0.286, np.random.default_rng(0)), (0.72, 0.56, 0.32))
    np.testing.assert_allclose(BinSettings((0.4, 0.3, 0.2), 0).sample(0.1, np.random.default_rng(0)), (0.4, 0.3, 0.2))


def test_the_bin_grows_for_bulky_parts_only(bracket: Part) -> None:
    assert BinSettings().scaling_diameter(bracket, 3) == bracket.diameter
    diameter = BinSettings().scaling_diameter(bracket, 150)
    assert diameter > bracket.diameter
    volume = np.prod(BinSettings(jitter=0).sample(diameter, np.random.default_rng(0)))
    assert 150 * ConvexHull(bracket.vertices).volume == pytest.approx(0.45 * volume)
    # A given size rules, also over the camera's distance.
    assert BinSettings((0.72, 0.3, 0.2)).scaling_diameter(bracket, 150) == pytest.approx(2 * 0.143)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: BinSettings(size=(0.3, 0.0, 0.1)), "^size must be .*greater than 0 and at most 100; got 0.0"),
        (lambda: BinSettings(jitter=0.6), "^jitter must be at least 0 and at most 0.5; got 0.6"),
        (lambda: DropSettings(timestep=0.02), "^timestep must be at least 0.0001 and at most 0.01; got 0.02"),
        (lambda: DropSettings(contact_time=0.007), r"drop contact_time must be at least two time steps \(0.008 s\)"),
        (lambda: DropSettings(friction=(0.6, 0.2)), "drop friction must be a range within 0..2"),
        (lambda: DropSettings(speed=-1), "^speed must be greater than 0 and at most 5; got -1"),
        (lambda: DropSettings(timeout=0.1), "^timeout must be greater than 0.25 and at most 30; got 0.1"),
    ],
)
def test_impossible_settings(make: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["connecting_rod", "gear"])
def test_true_surfaces_neither_penetrate_nor_hover(name: str, slow: SimpleNamespace, tmp_path: Path) -> None:
    """Measured on the true meshes, not on the physics engine's own contacts."""
    part = load_part(name, f"builtin:{name}")
    hulls, rng = convex_hulls(part, cache=tmp_path), np.random.default_rng(0)
    size = BinSettings().sample(BinSettings().scaling_diameter(part, 30), rng)
    part_ids = np.zeros(12, dtype=np.int32)
    poses = list(drop_parts([Solid(part, hulls)], part_ids, size, 0.4, DropSettings(), rng))[-1]
    assert len(poses) == 12
    triangles = part.vertices[part.faces]
    vertices = part.vertices[rng.permutation(len(part.vertices))[:400]]
    samples = np.concatenate([part.surface_points(400, rng), vertices])
    low, high = part.vertices.min(axis=0), part.vertices.max(axis=0)
    gaps = []
    for i, pose in enumerate(poses):
        world = apply(pose, samples)
        gap = [world[:, 2].min()]
        for j in range(len(poses)):
            inverse = np.linalg.inv(poses[j])
            local = apply(inverse, world)
            near = ((local > low - 0.003) & (local < high + 0.003)).all(axis=1)
            if i == j or not near.any():
                continue
            distance = slow.distance(local[near], triangles)
            inside = slow.inside(local[near], triangles)
            assert distance[inside].max(initial=0) <= 0.005 * part.diameter
            gap.append(distance.min())
        gaps.append(min(gap))
    assert min(gaps) >= -0.005 * part.diameter
    # Something is within reach of every part; samples are 5 mm apart, so a contact is not always hit exactly.
    assert max(gaps) < 0.03 * part.diameter
