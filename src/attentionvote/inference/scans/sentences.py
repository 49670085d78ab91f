"""Sentences about untrusted files: one line, whatever names and numbers of the file they quote."""

from __future__ import annotations

_MOST_CHARACTERS = 600


def single_line(sentence: str) -> str:
    """A sentence without line ends and control characters, of at most 600 characters."""
    if len(sentence) > _MOST_CHARACTERS:
        sentence = sentence[: _MOST_CHARACTERS - 1] + "…"
    return "".join(character if character.isprintable() else "?" for character in sentence)
