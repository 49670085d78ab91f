"""Generate the scene sets of a part: piles in a bin by physics, as poses, visibility and cameras.

    make generate OBJECT=connecting_rod [ARGS="simulation=fast simulation.cycles.train=40"]

Interrupted, also by kill -9, it goes on where it was. What exists is not generated again. Many machines share the work
with executor=ray or executor=slurm (docs/scaling.md).
"""

from __future__ import annotations

import logging
import shutil
import time
from pathlib import Path
from typing import Any

from attentionvote.command.entry import command, configuring
from attentionvote.command.errors import ConfigurationError
from attentionvote.command.executors import executor_of
from attentionvote.execution.hardware import cores
from attentionvote.workflows.settings import GenerateSettings

log = logging.getLogger("attentionvote.generate")


def run(cfg: GenerateSettings) -> dict[str, Any]:
    """Generate every asked-for split; digests and counts per split."""

    from attentionvote.simulation.resolution import log_resolution
    from attentionvote.simulation.scene_set import generate_scene_set
    from attentionvote.simulation.scene_spec import scene_set_directory, scene_set_specs

    start = time.monotonic()
    with configuring(f"object {cfg.object.name}"):
        part = cfg.object()
    with configuring():
        specs = scene_set_specs(part, cfg.simulation)
        executor = executor_of(cfg)
    unknown = [split for split in cfg.splits if split not in specs]
    if unknown or not cfg.splits:
        raise ConfigurationError(f"splits must be among {', '.join(specs)}; got {list(cfg.splits)}")
    log_resolution(log, part, cfg.simulation)
    sets = {}
    for split in cfg.splits:
        directory = scene_set_directory(Path(cfg.root), part.name, specs[split])
        if cfg.force and directory.exists():
            shutil.rmtree(directory)
        scenes = generate_scene_set(part, specs[split], directory, cfg.workers or cores(), executor=executor)
        log.info("%s: %d scenes of %d cycles in %s", split, len(scenes), scenes.cycles, directory)
        sets[split] = {
            "directory": str(directory),
            "scenes": len(scenes),
            "cycles": scenes.cycles,
            "digest": scenes.digest,
            "spec_digest": scenes.spec_digest,
        }
    return {"stage": "generate", "object": part.name, "sets": sets, "seconds": round(time.monotonic() - start, 1)}


if __name__ == "__main__":
    command(GenerateSettings, run)
