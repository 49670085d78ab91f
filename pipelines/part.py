"""Add your own part: checks the mesh, finds diameter, frame and symmetry, writes conf/object/NAME.yaml.

make part NAME=widget MESH=widget.step [BODY=1 SENSOR=phoxi_m BIN=360x280x160 DISTANCE=800]
"""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

from attentionvote.cad.part_configuration import configuration_text, symmetry_settings
from attentionvote.command.conf_folder import new_file
from attentionvote.command.entry import command, configuring
from attentionvote.command.errors import ConfigurationError
from attentionvote.files import whole, write_whole
from attentionvote.workflows.part_cell import cell_facts, cell_of
from attentionvote.workflows.settings import PartSettings

log = logging.getLogger("attentionvote.part")

NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")


def run(cfg: PartSettings) -> dict[str, Any]:
    """Write mesh, picture and, last, the configuration; the figures and the paths."""
    name = _checked_name(cfg)
    config = new_file("object", name) if cfg.objects is None else Path(cfg.objects) / f"{name}.yaml"
    if not cfg.mesh:
        raise ConfigurationError("mesh must be given, e.g. mesh=widget.stl")
    if config.exists() and not cfg.force:
        raise ConfigurationError(f"object {name!r} exists already ({config}), add force=true to replace it")

    from attentionvote.cad.mesh_file import check_written, largest_vertex_distance, write_surface
    from attentionvote.cad.part_import import import_part
    from attentionvote.cad.part_picture import write_picture
    from attentionvote.cad.part_report import examine
    from attentionvote.geometry import pose
    from attentionvote.part import Part
    from attentionvote.simulation.cell_text import cell_text

    with configuring():
        imported = import_part(cfg.mesh, cfg.units, cfg.body, Path(cfg.parts) / f"{name}-refused.png")
        log.info("%s", imported.line)
        vertices, faces = imported.vertices, imported.faces
        diameter = largest_vertex_distance(vertices)
        size = " x ".join(f"{e * 1000:.1f}" for e in vertices.max(0) - vertices.min(0))
        log.info("%s: %d triangles, %s mm, D %.2f mm; looking for symmetries", name, len(faces), size, diameter * 1e3)
        cell = cell_of(cfg, vertices, faces, diameter)
        report = examine(vertices, faces, cfg.tolerance)
        finding = report.finding
        vertices = pose.apply(finding.part_from_file, vertices)
        check_written(vertices, faces, Path(cfg.mesh).name)
    title = cfg.title or name.replace("_", " ").capitalize()
    part = Part(name, vertices, faces, round(diameter, 9), finding.symmetry, str(title))
    for line in report.lines:
        log.info("%s", line)
    if finding.moved:
        log.info("the part frame is not the file's: see part_from_file in %s", config)

    mesh, picture = Path(cfg.parts) / f"{name}.ply", Path(cfg.parts) / f"{name}.png"
    whole(mesh, lambda path: write_surface(part.vertices, part.faces, path))
    whole(picture, lambda path: write_picture(part, path))
    write_whole(config, configuration_text(part, report, mesh, imported.line) + cell_text(cell))
    log.info("look at %s, then: make train OBJECT=%s", picture, name)
    return {
        "stage": "part",
        "object": name,
        "config": str(config),
        "mesh": str(mesh),
        "picture": str(picture),
        "triangles": len(part.faces),
        "healed": imported.report,
        "surface_moved": imported.moved,
        "diameter": part.diameter,
        "covariance_root": part.covariance_root.round(9),
        "cell": cell_facts(cell),
        "symmetry": symmetry_settings(part),
        **report.facts,
    }


def _checked_name(cfg: PartSettings) -> str:
    name = str(cfg.name)
    if not name:
        raise ConfigurationError("name must be given, e.g. name=widget")
    if not NAME.fullmatch(name):
        nearest = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
        nearest = nearest if NAME.fullmatch(nearest) else f"part_{nearest}"[:64].rstrip("_")
        raise ConfigurationError(
            f"name must be small letters, digits and underscores, a letter first; got {name!r}, e.g. name={nearest}"
        )
    return name


if __name__ == "__main__":
    command(PartSettings, run)
