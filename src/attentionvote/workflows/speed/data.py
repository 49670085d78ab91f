"""Rows of ``make bench`` about training data: samples from stored poses, samples of later epochs, settled scenes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from attentionvote.data.samples import Batch, draw_sample
from attentionvote.data.sensing import measure
from attentionvote.geometry import native
from attentionvote.geometry.pose import apply, inverse
from attentionvote.part import Part
from attentionvote.simulation.cycle import simulate_cycle, solids_of
from attentionvote.simulation.scene_record import SceneRecord
from attentionvote.workflows.speed.contest import Contest, Unequal
from attentionvote.workflows.speed.material import Material
from attentionvote.workflows.speed.points import degrees_apart, identical

SLOW = "numpy and scipy"
MOST_PENETRATION = 0.005  # of D
_SURFACE_POINTS = 2_000

Result = TypeVar("Result")


def slowly(call: Callable[[], Result]) -> Callable[[], Result]:
    """The same call with the slow references in place of the C code."""

    def run() -> Result:
        with native.disabled():
            return call()

    return run


def tensors(batch: Batch) -> list[Any]:
    """All arrays of a sample or batch."""
    return [
        np.asarray(value)
        for value in (*batch[:3], *batch[4:], batch.neighborhoods.order, *sum(batch.neighborhoods[1:], ()))
    ]


def new_sample(material: Material, size: str) -> Contest:
    """Rays, noise, normals of as many points as a sample has, order and neighbours."""
    cfg, layout = material.trainings[size], material.network(size).layout
    settings = material.cloud_settings(size)
    settings = replace(settings, pool=min(cfg.data.points, settings.density))
    record, caster, motion = material.record, material.caster, cfg.data.augmentation

    def fast() -> list[Any]:
        scene = measure(record, caster, settings)
        return tensors(draw_sample(scene, cfg.data.points, layout, motion, material.rng()))

    def compare(fast: list[Any], others: Mapping[str, list[Any]]) -> str:
        points, normals, *rest = fast
        for name, (other_points, other_normals, *others_rest) in others.items():
            worst = degrees_apart(normals, other_normals, name)
            identical([points, *rest], {name: [other_points, *others_rest]})
        return f"identical, normals within {worst:.4f} degrees"

    text = f"{cfg.data.points:,} of {settings.density:,} points, {len(record.camera_from_part)} instances"
    return Contest(fast, {SLOW: slowly(fast)}, compare, text)


def cached_sample(material: Material, size: str) -> Contest:
    """A scene's measured cloud read from disk, a part of it drawn and moved, order and neighbours."""
    from attentionvote.data.datamodule import CloudSamples  # Lightning: seconds

    cfg = material.trainings[size]
    samples = CloudSamples(
        material.stored(size),
        cfg.data.points,
        material.network(size).layout,
        cfg.data.augmentation,
        material.seed,
    )

    def fast() -> list[Any]:
        return tensors(samples[1, 0])

    text = f"{cfg.data.points:,} of {len(samples.clouds[0].points):,} points"
    return Contest(fast, {SLOW: slowly(fast)}, identical, text)


def settled_scenes(material: Material) -> Contest:
    """Physics, guards, cameras and visibility of one cycle, its convex pieces given; there is no other path."""
    spec, part, caster = material.cycle, material.part, material.caster
    solids = solids_of(part, spec.drop)

    def fast() -> list[SceneRecord]:
        return simulate_cycle(part, solids, caster, spec, 0)

    scenes = fast()

    def compare(fast: list[SceneRecord], _: Mapping[str, Any]) -> str:
        for a, b in zip(scenes, fast, strict=True):
            if not np.array_equal(a.camera_from_part, b.camera_from_part):
                raise Unequal("a cycle must be the same when it is simulated again, but its poses differ")
        share = max(penetration(material, record) for record in (fast[0], fast[len(fast) // 2], fast[-1]))
        if share > MOST_PENETRATION:
            raise Unequal(f"parts must rest at most {MOST_PENETRATION:.1%} of D inside each other, got {share:.2%}")
        return f"the same again, penetration at most {share:.2%} of D"

    text = f"{len(scenes)} scenes of up to {spec.drop_counts[-1]} parts"
    return Contest(fast, {}, compare, text, items=len(scenes))


def penetration(material: Material, record: SceneRecord) -> float:
    """Greatest depth, as a share of D, of a surface point of one part inside another, on the true surfaces."""
    import trimesh

    from attentionvote.cad.surface_distance import SurfaceDistance

    deepest, poses, kinds = 0.0, record.camera_from_part, record.part_ids
    parts = material.part.parts
    solids = [trimesh.Trimesh(part.vertices, part.faces, process=False) for part in parts]
    surfaces = [SurfaceDistance(part.vertices, part.faces) for part in parts]
    samples = [_surface(part, material) for part in parts]
    for i, pose in enumerate(poses):
        points = apply(pose, samples[kinds[i]])
        for j, other in enumerate(poses):
            part = parts[kinds[j]]
            if i == j or np.linalg.norm(pose[:3, 3] - other[:3, 3]) > material.part.diameter + part.diameter:
                continue
            local = apply(inverse(other), points)
            low, high = part.box
            local = local[((local > low) & (local < high)).all(axis=1)]
            inside = local[solids[kinds[j]].contains(local)] if len(local) else local
            if len(inside):
                deepest = max(deepest, float(surfaces[kinds[j]](inside).max()) / part.diameter)
    return deepest


def _surface(part: Part, material: Material) -> Any:
    return np.concatenate([part.vertices, part.surface_points(_SURFACE_POINTS, material.rng())])
