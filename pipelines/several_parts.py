"""Which verbs know a bin of several parts: the others refuse it in one sentence before any work."""

from __future__ import annotations

from attentionvote.part import Part, Parts


def only_part(parts: Parts, verb: str) -> Part:
    """The part of an object that describes one.

    Raises:
        ValueError: when it describes several.
    """
    if len(parts.parts) > 1:
        names = ", ".join(part.name for part in parts.parts)
        raise ValueError(
            f"object must be one part for {verb}, got {parts.name} with the parts {names}: choose one of them "
            "(docs/several-parts.md says what works for several)"
        )
    return parts.parts[0]
