"""What a bin of several parts means for the verbs: which refuse it, what the network is told, what a model keeps."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from attentionvote.model.settings import NetworkSettings
from attentionvote.part import Parts


def check_classes(classes: int, parts: Parts) -> None:
    """Refuse a number of classes that was typed and is not the number of parts; 1 is the presets' default.

    Raises:
        ValueError: when it is another number.
    """
    if classes not in (1, len(parts.parts)):
        raise ValueError(
            f"model.classes must be the number of parts of {parts.name} ({len(parts.parts)}), got {classes}: "
            "leave it out, the object decides"
        )


def network_arguments(model: NetworkSettings, parts: Parts) -> dict[str, Any]:
    """Arguments of the network: the settings, and what the parts decide (lengths, box, classes)."""
    arguments = asdict(model)
    arguments |= {"diameter": parts.diameter, "box": parts.box.tolist(), "classes": len(parts.parts)}
    if len(parts.parts) > 1 and arguments["merge_fraction"] is not None:
        # The box holds all parts; stacked instances of the thinnest must stay apart all the same.
        thinnest = min(float((part.box[1] - part.box[0]).min()) for part in parts.parts)
        arguments["merge_fraction"] = min(arguments["merge_fraction"], 0.5 * thinnest / parts.diameter)
    return arguments


def described(parts: Parts) -> dict[str, Any]:
    """What a checkpoint keeps of its part, under ``part``; of a set also of each of its parts, under ``parts``."""
    if len(parts.parts) == 1:
        return {"part": _facts(parts) | {"symmetry": asdict(parts.parts[0].symmetry)}}
    each = [_facts(part) | {"symmetry": asdict(part.symmetry)} for part in parts.parts]
    return {"part": _facts(parts), "parts": each}


def _facts(part: Parts) -> dict[str, Any]:
    return {"name": part.name, "title": part.title, "diameter": float(part.diameter), "digest": part.digest}
