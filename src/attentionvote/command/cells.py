"""The cell of an object in the settings of a verb: what the user leaves open is as the part's own cell has it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import asdict
from typing import Any

from attentionvote.command.errors import ConfigurationError
from attentionvote.section import read
from attentionvote.simulation.cell import CellSettings

# Sections of which all is the user's when a group of theirs says something else of any of it.
_BLOCKS = ("simulation.bin.walls", "simulation.camera.camera", "data.sensor", "evaluation.sensor")
_WIDE = 1500  # pixels of a picture from which visibility is measured on every fourth in place of every second


def with_cell(
    plain: dict[str, Any], defaults: Callable[[], Mapping[str, Any]], keys: Collection[str]
) -> dict[str, Any]:
    """Composed settings with the values of the object's cell, which is no part of them afterwards: whatever is made of
    them, identities and stored configurations, has its values where every user looks for them.

    A word of the user's wins. So does a choice of a group that says anything else of a camera, a sensor or walls than
    the verb's own configuration: a whole one of these, since half a camera of the user's and half a cell's is none.

    Args:
        plain: as composed; not changed.
        defaults: gives the same of the object alone, without a word of the user's.
        keys: dotted names of the settings that the user's words set.

    Raises:
        SettingError: on an impossible cell.
        ConfigurationError: when the parts of a set have different cells.
    """
    section = plain.get("object")
    if not isinstance(section, Mapping):
        return plain
    cell, rest = _taken(section)
    plain = {**plain, "object": rest}
    if cell is None:
        return plain
    values = list(_values(read(CellSettings, cell, "object.cell")))
    before, composed = defaults(), plain
    for key, value in values:
        block = next((block for block in _BLOCKS if key.startswith(f"{block}.")), key)
        is_worded = any(key == word or key.startswith(f"{word}.") for word in keys)
        if key.partition(".")[0] in plain and not is_worded and not _is_from_a_group(block, composed, before, keys):
            plain = _with(plain, key.split("."), value)
    return plain


def _taken(section: Mapping[str, Any]) -> tuple[Mapping[str, Any] | None, dict[str, Any]]:
    """The cell of an object, and the object without it."""
    rest = {name: value for name, value in section.items() if name != "cell"}
    cell = section.get("cell")
    members = section.get("parts")
    if isinstance(members, Mapping):
        cells = {str(n): member.get("cell") for n, member in members.items() if isinstance(member, Mapping)}
        rest["parts"] = {
            name: {k: v for k, v in member.items() if k != "cell"} if isinstance(member, Mapping) else member
            for name, member in members.items()
        }
        first = next(iter(cells), None)
        for name, other in cells.items():
            if first is not None and cell is None and _without_area(other) != _without_area(cells[first]):
                raise ConfigurationError(
                    f"the parts of a set must have one cell, but those of {first} and {name} differ: make them with "
                    "the same SENSOR, BIN and DISTANCE, or give the set a cell of its own"
                )
        one = cells.get(first or "")
        if cell is None and one is not None:
            # The area follows the size of each part's heap: the largest holds them all, none is the whole floor.
            areas = [other["area"] for other in cells.values() if other and other.get("area") is not None]
            whole = len(areas) < len(cells)
            cell = {**one, "area": None if whole else [max(side) for side in zip(*areas, strict=True)]}
    return cell, rest


def _without_area(cell: Any) -> Any:
    return {name: value for name, value in cell.items() if name != "area"} if isinstance(cell, Mapping) else cell


def _values(cell: CellSettings) -> Iterator[tuple[str, Any]]:
    """Dotted settings of any verb with what the cell says."""
    yield "simulation.bin.size", list(cell.bin.size)
    yield "simulation.bin.jitter", cell.bin.jitter
    for name, value in asdict(cell.bin.walls).items():
        yield f"simulation.bin.walls.{name}", value
    for name, value in asdict(cell.camera).items():
        yield f"simulation.camera.camera.{name}", value
    yield "simulation.camera.distance", cell.distance
    yield "simulation.camera.distance_jitter", cell.distance_jitter
    if cell.area is not None:
        yield "simulation.drop.area", list(cell.area)
    if cell.hull_volume is not None:
        yield "simulation.drop.hull_volume", cell.hull_volume
    if cell.camera.width >= _WIDE:
        yield "simulation.visibility_stride", 4
    if cell.measures is None:
        return
    measures = asdict(cell.measures) | {"grazing_degrees": list(cell.measures.grazing_degrees)}
    for section in ("data.sensor", "evaluation.sensor"):
        for name, value in measures.items():
            yield f"{section}.{name}", value
    yield "sensor", cell.measures.preset  # of view
    yield "scanner", measures


def _is_from_a_group(block: str, plain: Any, defaults: Any, keys: Collection[str]) -> bool:
    """Whether a group that the user chose says something else of a setting or a section than the verb's defaults; what
    words say is left aside."""
    for name in block.split("."):
        plain, defaults = ((at.get(name) if isinstance(at, Mapping) else None) for at in (plain, defaults))
    ours, theirs = dict(_leaves(defaults, block)), dict(_leaves(plain, block))
    return any(
        ours.get(key) != theirs.get(key)
        for key in ours.keys() | theirs.keys()
        if not any(key == word or key.startswith(f"{word}.") for word in keys)
    )


def _leaves(node: Any, key: str) -> Iterator[tuple[str, Any]]:
    if isinstance(node, Mapping):
        for name, value in node.items():
            yield from _leaves(value, f"{key}.{name}")
    else:
        yield key, node


def _with(plain: Mapping[str, Any], names: list[str], value: Any) -> dict[str, Any]:
    """A copy with a value at a place."""
    first, *more = names
    inner = plain.get(first)
    return {**plain, first: _with(inner if isinstance(inner, Mapping) else {}, more, value) if more else value}
