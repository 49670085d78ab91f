"""Look at a scene: an interactive 3D page and pictures of depth, instances and visibility.

make view OBJECT=connecting_rod [ARGS="scene=3 sensor=phoxi split=test"]
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from attentionvote.command.entry import command, configuring
from attentionvote.command.errors import ConfigurationError
from attentionvote.workflows.settings import ViewSettings

log = logging.getLogger("attentionvote.view")


def run(cfg: ViewSettings) -> dict[str, Any]:
    """Write the page and the pictures; their paths and what is in them."""
    import numpy as np

    from attentionvote.simulation.raycast import PartCaster
    from attentionvote.simulation.scene_set import find_record
    from attentionvote.simulation.scene_spec import scene_set_directory, scene_set_specs
    from attentionvote.simulation.scene_view import write_view
    from attentionvote.simulation.sensor import synthesize

    with configuring(f"object {cfg.object.name}"):
        part = cfg.object()
    with configuring():
        sensor = cfg.shown_sensor
        specs = scene_set_specs(part, cfg.simulation)
    if cfg.split not in specs:
        raise ConfigurationError(f"split must be one of {', '.join(specs)}; got {cfg.split!r}")
    spec, caster = specs[cfg.split], PartCaster(part)
    with configuring():
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
    command(ViewSettings, run)
