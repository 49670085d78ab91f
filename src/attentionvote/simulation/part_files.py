"""Parts by name: a built-in of the catalogue, or the user's mesh file; and sets of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from attentionvote.geometry.symmetry import Symmetry
from attentionvote.part import Part, PartSet
from attentionvote.setting import Identity, Setting
from attentionvote.simulation.cell import CellSettings

BUILTIN = "builtin:"


def _no_symmetry(value: object) -> str:
    """What is wrong with a value that is no symmetry at all."""
    keys = ", ".join(Symmetry.__dataclass_fields__)
    return "" if isinstance(value, (Mapping, Symmetry)) else f"must be a section with keys {keys}; got {value!r}"


def load_part(
    name: Annotated[str, Setting("Stem of the configuration file.")],
    mesh: Annotated[str, Setting("builtin:NAME of the catalogue, or the path of a mesh file in the part frame.")],
    diameter: Annotated[float | None, Setting("D in metres; null = from the surface.", above=0, high=10)] = None,
    units: Annotated[str, Setting("Unit of the file's numbers.", choices=("m", "cm", "mm", "inch"))] = "m",
    symmetry: Annotated[Any, Setting("Proper symmetry in the part frame.", problem=_no_symmetry)] = None,
    title: Annotated[str, Setting("One line for people.", identity=Identity.ONCE)] = "",
    base_radius: Annotated[float | None, Setting("r of the network, metres; null = from D.", above=0, high=10)] = None,
    voxel_size: Annotated[float | None, Setting("Of the heatmap, metres; null = from D.", above=0, high=10)] = None,
    near_symmetric: Annotated[
        Any, Setting("Turns after which the part nearly looks like itself.", identity=Identity.NEVER)
    ] = None,
    mirror_image: Annotated[
        Any, Setting("How alike the part and its mirror image are.", identity=Identity.NEVER)
    ] = None,
    # Its values stand in the settings that identify a result (command/cells.py).
    cell: Annotated[  # noqa: ARG001
        CellSettings | None,
        Setting("Sensor, distance and bin; null = the benchmark's, scaled with D.", identity=Identity.NEVER),
    ] = None,
) -> Part:
    """The part that ``conf/object/NAME.yaml`` describes.

    Args:
        name: stem of the configuration file.
        mesh: ``builtin:NAME`` of the catalogue, or the path of a mesh file in the part frame.
        diameter: D in metres; left out, the built-in's, or the largest vertex distance of the file.
        units: unit of the file's numbers (m, cm, mm, inch).
        symmetry: proper symmetry in the part frame; left out, the built-in's, or none.
        title: one line for people.
        base_radius: override of a scale setting in metres; conf/model takes it from here, not used by the part.
        voxel_size: the same for the voxel size.
        near_symmetric, mirror_image: what ``make part`` found, for people and later stages; not used by the part.
        cell: sensor, distance and bin; the settings of a verb take it from here, not used by the part.

    Raises:
        ValueError: with one sentence, on an unknown built-in, a broken mesh or an impossible symmetry.
        FileNotFoundError: when the mesh file is missing; the sentence says where it comes from.
    """
    for key, value in (("base_radius", base_radius), ("voxel_size", voxel_size), ("diameter", diameter)):
        if value is not None and not 0 < value <= 10:
            raise ValueError(f"{name}: {key} must be positive metres (at most 10) or null, got {value}")
    for label, value, kind in (("near_symmetric", near_symmetric, list), ("mirror_image", mirror_image, Mapping)):
        if value is not None and not isinstance(value, kind):
            raise ValueError(f"{name}: {label} must be as `make part` writes it, got {value!r}: leave it out")
    from attentionvote.cad.builtin import BUILTIN_PARTS, builtin_surface
    from attentionvote.cad.mesh_file import largest_vertex_distance, load_surface
    from attentionvote.cad.part_claims import check_claims

    group = _symmetry(name, symmetry)
    if mesh.startswith(BUILTIN):
        key = mesh.removeprefix(BUILTIN)
        vertices, faces = builtin_surface(key)
        entry = BUILTIN_PARTS[key]
        return Part(
            name, vertices, faces, diameter or entry.diameter, entry.symmetry if group is None else group,
            title or entry.title,
        )  # fmt: skip
    if not Path(mesh).is_file():
        raise FileNotFoundError(
            f"mesh of object '{name}', {title or name}, must be at '{mesh}', which does not exist: put the file there"
            " (a dataset's mesh comes with the dataset), or set ATTENTIONVOTE_DATA or object.mesh to where you have it"
        )
    vertices, faces = load_surface(mesh, units)
    part = Part(name, vertices, faces, diameter or largest_vertex_distance(vertices), group or Symmetry(), title)
    check_claims(part)
    return part


def load_parts(
    name: Annotated[str, Setting("Stem of the configuration file.")],
    parts: Annotated[Any, Setting("By name the settings of each part, in the order of the network's classes.")],
    title: Annotated[str, Setting("One line for people.", identity=Identity.ONCE)] = "",
    base_radius: Annotated[float | None, Setting("r of the network, metres; null = from D.", above=0, high=10)] = None,
    voxel_size: Annotated[float | None, Setting("Of the heatmap, metres; null = from D.", above=0, high=10)] = None,
    cell: Annotated[  # noqa: ARG001
        CellSettings | None, Setting("As of a part; null = the parts' own.", identity=Identity.NEVER)
    ] = None,
) -> PartSet:
    """The set of parts in one bin that ``conf/object/NAME.yaml`` describes.

    Args:
        name: stem of the configuration file.
        parts: by name the arguments of ``load_part`` (keys that begin with ``_`` are Hydra's), or parts that are loaded
            already, in the order of the network's classes; at least two.
        title: one line for people.
        base_radius, voxel_size: as in ``load_part``; left out, derived from D of the largest part.
        cell: as in ``load_part``; left out, that of the parts.

    Raises:
        ValueError: with one sentence, on too few parts, settings that describe none, or two that cannot be told apart.
        FileNotFoundError: as ``load_part``.
    """
    if not isinstance(parts, Mapping) or len(parts) < 2:
        listed = ", ".join(map(str, parts)) if isinstance(parts, Mapping) else repr(parts)
        raise ValueError(f"{name}: parts must be at least two parts by name, got {listed or 'none'}")
    for key, value in (("base_radius", base_radius), ("voxel_size", voxel_size)):
        if value is not None and not 0 < value <= 10:
            raise ValueError(f"{name}: {key} must be positive metres (at most 10) or null, got {value}")
    members = tuple(_member(name, key, settings) for key, settings in parts.items())
    from attentionvote.cad.part_claims import check_set

    made = PartSet(name, members, title)
    check_set(name, members)
    return made


def _member(name: str, key: str, settings: Part | Mapping[str, Any]) -> Part:
    if isinstance(settings, Part):
        return settings
    try:
        return load_part(**{k: v for k, v in settings.items() if not k.startswith("_")})
    except (TypeError, AttributeError) as error:
        raise ValueError(
            f"{name}: parts.{key} must be the settings of one part, as in conf/object, got {settings!r}"
        ) from error


def _symmetry(name: str, symmetry: Mapping[str, Any] | Symmetry | None) -> Symmetry | None:
    if symmetry is None or isinstance(symmetry, Symmetry):
        return symmetry
    keys = set(Symmetry.__dataclass_fields__)
    unknown = sorted(set(symmetry) - keys)
    if unknown:
        raise ValueError(f"{name}: symmetry must only have the keys {', '.join(sorted(keys))}, got '{unknown[0]}'")
    try:
        return Symmetry(**dict(symmetry))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
