"""One drop cycle: which parts fall, and the scenes they make."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from attentionvote.part import Parts
from attentionvote.simulation.decomposition import convex_hulls
from attentionvote.simulation.drop import Solid, drop_parts
from attentionvote.simulation.drop_settings import DropSettings
from attentionvote.simulation.raycast import BinSurface, PartCaster
from attentionvote.simulation.scene_record import SceneRecord
from attentionvote.simulation.scene_spec import SceneSetSpec


def draw_part_ids(parts: int, count: int, rng: np.random.Generator) -> NDArray[np.int32]:
    """``(count,)`` which of ``parts`` each drop is: every part once, in random order, then any, so that a pile of at
    least as many drops as parts holds all of them ("objects including all categories", paper section 4.1)."""
    return np.concatenate([rng.permutation(parts), rng.integers(parts, size=count)])[:count].astype(np.int32)


def simulate_cycle(
    part: Parts, solids: Sequence[Solid], caster: PartCaster, spec: SceneSetSpec, cycle: int
) -> list[SceneRecord]:
    """The scenes of one drop cycle; a pure function of its arguments.

    Args:
        part: what lies in the bin.
        solids: of its parts, in their order.
        caster: of the same.
        spec: of the set.
        cycle: which one.
    """
    most = spec.drop_counts[-1]
    physics_seed, *scene_seeds, parts_seed = spec.cycle_seed(cycle).spawn(2 + len(spec.drop_counts))
    part_ids = draw_part_ids(len(solids), most, np.random.default_rng(parts_seed))
    rng = np.random.default_rng(physics_seed)
    scale = spec.bin.scaling_diameter(part, most)
    bin_size = spec.bin.sample(scale, rng)
    friction = float(rng.uniform(*spec.drop.friction))
    counts = spec.counts_of(cycle)
    seeds = {count: seed for count, seed in zip(spec.drop_counts, scene_seeds, strict=True) if count in counts}
    records = []
    walls = spec.bin.walls
    piles = drop_parts(solids, part_ids, bin_size, friction, spec.drop, rng, drops=counts[-1], walls=walls)
    for bin_from_part in piles:
        count = len(bin_from_part)
        if count not in seeds:
            continue
        scene_rng = np.random.default_rng(seeds[count])
        camera_from_bin = spec.camera.sample(scale, float(bin_size[2]), scene_rng)
        camera_from_part = camera_from_bin @ bin_from_part
        surface, dropped_ids = BinSurface(bin_size, camera_from_bin, walls), part_ids[:count]
        records.append(
            SceneRecord(
                cycle=cycle,
                drop_count=count,
                camera_from_part=camera_from_part,
                visible_fraction=caster.visible_fraction(
                    camera_from_part, spec.camera.camera, surface, spec.visibility_stride, dropped_ids
                ),
                camera=spec.camera.camera,
                camera_from_bin=camera_from_bin,
                bin_size=bin_size,
                friction=friction,
                scene_seed=int(scene_rng.integers(2**63)),
                part_ids=dropped_ids,
                walls=walls,
            )
        )
    return records


def solids_of(part: Parts, settings: DropSettings) -> list[Solid]:
    """The parts with their convex pieces."""
    return [
        Solid(
            member,
            convex_hulls(member, settings.hull_threshold, settings.hull_vertices, most_volume=settings.hull_volume),
        )
        for member in part.parts
    ]
