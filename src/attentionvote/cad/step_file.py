"""STEP files: exact surfaces, cut into triangles as finely as the part's size asks for, in the file's own unit."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from attentionvote.cad.mesh_file import largest_vertex_distance

STEP_FORMATS = (".step", ".stp")
CHORD = 2e-4  # of D: how far a triangle may lie from the exact surface
MOST_TIMES_FINER = 10
ANGLE = 0.25  # rad between neighbours: 25 to a full turn, also on fillets that are small
_PREFIXES = {"$": "m", ".CENTI.": "cm", ".MILLI.": "mm"}
_LENGTH = re.compile(r"#(\d+)\s*(=\s*\([^;]*LENGTH_UNIT\s*\([^;]*\)\s*;)")
_SI = re.compile(r"SI_UNIT\s*\(\s*(?P<prefix>\$|\.\w+\.)\s*,\s*\.METRE\.\s*\)")
_NAMED = re.compile(r"CONVERSION_BASED_UNIT\s*\(\s*'(?P<name>[^']*)'")
_CONTEXT = re.compile(r"GLOBAL_UNIT_ASSIGNED_CONTEXT\s*\(\s*\(([^)]*)\)", re.DOTALL)


def read_step(
    path: Path, units: str | None = None, body_diameter: float | None = None
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices ``(V, 3)`` in metres and faces ``(F, 3)`` of all solids of a STEP file, placed as the assembly has them.

    Args:
        path: a STEP file (AP203, AP214, AP242).
        units: what the user believes; None = nothing. The file knows, and is right.
        body_diameter: D in metres of the body that is wanted of an assembly; None = of all of it.

    Raises:
        ValueError: with one sentence, when it cannot be read, says another unit, or cascadio is missing.
    """
    try:
        import cascadio
    except ImportError as error:
        raise ValueError(
            f"mesh '{path.name}' is a STEP file, which needs cascadio: run `make setup`, or pip install "
            "'attentionvote[cad]'"
        ) from error
    content = path.read_bytes()
    said = length_units(content.decode("latin-1"))
    if units is not None and said and said != {units}:
        word = " and ".join(sorted(said))
        raise ValueError(f"units must be left out for STEP file '{path.name}', which is in {word}; got {units}")
    # The first look is only for the size.
    rough = _triangles(cascadio, content, path.name, 0.2, 0.8, is_relative=True)
    diameter = largest_vertex_distance(rough.vertices)
    if body_diameter is not None:  # the rest of the assembly is cut as finely, and thrown away
        diameter = max(body_diameter, diameter / MOST_TIMES_FINER)
    # OpenCASCADE works in millimetres whatever the file's unit.
    mesh = _triangles(cascadio, content, path.name, CHORD * diameter * 1000, ANGLE, is_relative=False)
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def length_units(text: str) -> set[str]:
    """The units of length of the shapes in a STEP file: m, cm, mm, inch, or another as the file names it."""
    entities = dict(_LENGTH.findall(text))
    used = {i for context in _CONTEXT.findall(text) for i in re.findall(r"#(\d+)", context)}
    result = set()
    for number, entity in entities.items():
        if used and number not in used:
            continue
        if found := _NAMED.search(entity):
            result.add(_named(found["name"]))
        elif found := _SI.search(entity):
            result.add(_PREFIXES.get(found["prefix"], found["prefix"].strip(".").lower() + "metre"))
    return result


def _named(name: str) -> str:
    word = name.strip().lower().rstrip(".")
    known = {"inches": "inch", "in": "inch", "millimetre": "mm", "millimeter": "mm", "metre": "m", "centimetre": "cm"}
    return known.get(word, word)


def _triangles(
    cascadio: Any, content: bytes, name: str, chord: float, angle: float, *, is_relative: bool
) -> trimesh.Trimesh:
    # One thread: the order of its triangles, and so a part's digest, must not depend on the machine.
    glb = cascadio.load(content, "step", chord, angle, is_relative, use_parallel=False)
    if not glb:
        raise ValueError(f"mesh '{name}' could not be read as STEP: it holds no shapes that OpenCASCADE understands")
    mesh = trimesh.load_scene(io.BytesIO(glb), file_type="glb", process=False).to_mesh()
    if len(mesh.faces) < 4:
        raise ValueError(f"mesh '{name}' must hold a surface of at least 4 triangles, got {len(mesh.faces)}")
    return mesh
