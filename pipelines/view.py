"""Look at a scene: an interactive 3D page and pictures of depth, instances and visibility.

make view OBJECT=connecting_rod [ARGS="scene=3 sensor=phoxi split=test"]
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from attentionvote.command.entry import command, configuring
from attentionvote.command.errors import ConfigurationError

if TYPE_CHECKING:
    from attentionvote.part import Parts
    from attentionvote.simulation import PartCaster, SceneRecord, SceneSetSpec

log = logging.getLogger("attentionvote.view")


def find_record(part: Parts, caster: PartCaster, spec: SceneSetSpec, directory: Path, scene: int) -> SceneRecord:
    """Scene number ``scene`` of a set, or of the cycle it would belong to, when the set is not complete."""
    from attentionvote.simulation.scene_set import SceneSet, simulate_cycle, solids_of

    per_cycle = len(spec.drop_counts)
    if scene >= spec.cycles * per_cycle:
        raise ConfigurationError(f"scene must be below {spec.cycles * per_cycle} in split {spec.split}; got {scene}")
    if SceneSet.is_complete(directory):
        records = SceneSet.open(directory).records
        if scene >= len(records):
            raise ConfigurationError(f"scene must be below {len(records)}, the scenes in {directory}; got {scene}")
        return records[scene]
    cycle, entry = divmod(scene, per_cycle)
    log.info("%s is not generated yet: simulating its cycle %d", directory, cycle)
    cycle_records = simulate_cycle(part, solids_of(part, spec.drop), caster, spec, cycle)
    if not cycle_records:
        raise ConfigurationError(f"scene must lie in a cycle with a settled pile, cycle {cycle} has none; got {scene}")
    return cycle_records[min(entry, len(cycle_records) - 1)]


def run(cfg: DictConfig) -> dict[str, Any]:
    """Write the page and the pictures; their paths and what is in them."""
    import numpy as np
    from hydra.utils import instantiate

    from attentionvote.simulation import PartCaster, Sensor, scene_set_directory, scene_set_specs, synthesize
    from attentionvote.simulation.scene_view import write_view

    with configuring(f"object {cfg.object.name}"):
        part = instantiate(cfg.object)
    with configuring():
        sensor = Sensor(cfg.sensor, sigma_mm=cfg.sigma_mm)
        specs = scene_set_specs(part, OmegaConf.to_container(cfg.simulation))
    if cfg.split not in specs:
        raise ConfigurationError(f"split must be one of {', '.join(specs)}; got {cfg.split!r}")
    spec, caster = specs[cfg.split], PartCaster(part)
    record = find_record(part, caster, spec, scene_set_directory(Path(cfg.root), part.name, spec), cfg.scene)
    cloud = synthesize(record, caster, sensor, cfg.max_points, np.random.default_rng(record.scene_seed))
    files = write_view(
        Path(cfg.output) / f"{part.name}-{cfg.split}-{cfg.scene}-{cfg.sensor}", part, caster, record, cloud
    )
    log.info("open %s in a browser", files["scene.html"])
    return {
        "stage": "view",
        "object": part.name,
        "files": {name: str(path) for name, path in files.items()},
        "parts": record.drop_count,
        "points": len(cloud.points),
        "visible_fraction": record.visible_fraction.round(3),
    }


if __name__ == "__main__":
    command("view", run)
