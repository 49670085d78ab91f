"""Errors that end a verb with one sentence."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any

from attentionvote.files import disk_full


class ConfigurationError(ValueError):
    """What the user asked for is impossible; the message is one sentence. Ends a verb with exit code 2."""


def sentence(error: BaseException) -> str:
    """The message of ``error`` on one line, or the name of its class when it has none."""
    error = disk_full(error) or error
    if isinstance(error, FileNotFoundError) and error.filename is not None:
        return f"file not found: {error.filename}"
    return " ".join(str(error).split()) or type(error).__name__


def nearest(name: str, valid: Iterable[str]) -> str:
    """The end of a sentence, ``, did you mean 'x'?``, or nothing when no valid name is near."""
    names = list(valid)
    by_leaf = [v for v in names if v.rpartition(".")[2] == name.rpartition(".")[2]]
    close = by_leaf or get_close_matches(name, names, n=1, cutoff=0.6)
    if not close:
        leaves = {v.rpartition(".")[2]: v for v in reversed(names)}
        close = [leaves[leaf] for leaf in get_close_matches(name.rpartition(".")[2], leaves, n=1, cutoff=0.7)]
    return f", did you mean {close[0]!r}?" if close else ""


class Refused(ValueError):
    """The work is done and its outcome is no: the JSON line is printed all the same, the exit code is 1.

    Args:
        sentence: why.
        result: the dictionary of the JSON line.
    """

    def __init__(self, sentence: str, result: dict[str, Any]) -> None:
        super().__init__(sentence)
        self.result = result
