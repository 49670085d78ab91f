"""The cell of a new part: chosen by the user and the defaults of the world, said, and written for its configuration."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attentionvote.workflows.settings import PartSettings

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from attentionvote.simulation.cell import CellSettings

log = logging.getLogger("attentionvote.part")
_DENSITY = 40_000  # of conf/data


def cell_of(cfg: PartSettings, vertices: NDArray, faces: NDArray, diameter: float) -> CellSettings | None:
    """The cell that the settings mean for a surface of that diameter; says what its sensor can tell. None for a part
    that is larger than usual cells are made for, and of whose cell nothing is said.

    Raises:
        ValueError: with one sentence, when sensor, bin and distance do not fit together.
        FileNotFoundError: when there is no camera file.
    """
    from attentionvote.part import Part
    from attentionvote.simulation.cell_choice import NoUsualCell, choose_cell
    from attentionvote.simulation.resolution import resolution
    from attentionvote.simulation.scene_spec import SceneSetSpec
    from attentionvote.simulation.sensor import Sensor

    part, count = Part(cfg.name, vertices, faces, diameter), SceneSetSpec.drop_counts[-1]
    camera = None if cfg.camera is None else Path(cfg.camera)
    try:
        cell = choose_cell(part, count, cfg.sensor, cfg.bin, cfg.distance, camera)
    except NoUsualCell as error:
        if cfg.sensor or cfg.distance or camera:
            raise
        log.warning("the part gets no cell, its scenes scale with D as the benchmark's: %s", error)
        return None
    log.info("cell: %s at %g mm, bin %s mm", cell.sensor, cell.distance * 1000, _mm(cell.bin.size))
    if cell.area is not None:
        log.info("parts are dropped over %s mm of the bin's floor: a heap of %d", _mm(cell.area), count)
    measures = cell.measures or Sensor("gaussian")
    found = resolution(part, cell.camera, cell.distance, measures, _DENSITY, count, cell.bin.size)
    log.info("%s", found.sentence())
    if advice := found.advice():
        log.warning("%s", advice)
    return cell


def cell_facts(cell: CellSettings | None) -> dict[str, Any] | None:
    """The cell for the JSON line, metres."""
    if cell is None:
        return None
    return {
        "sensor": cell.sensor,
        "distance": cell.distance,
        "bin": list(cell.bin.size),
        "area": None if cell.area is None else list(cell.area),
    }


def _mm(sides: tuple[float, ...]) -> str:
    return " x ".join(f"{side * 1000:.4g}" for side in sides)
