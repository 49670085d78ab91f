"""The range of every setting: one table, first matching pattern wins.

Types need no table: an override must have the type of the default it replaces
(``pipelines/configuration.py``). Ranges hold for whatever the final value is, from a file or from the
command line. ``None`` (null) always passes: whether a setting may be null is its default's business.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any


@dataclass(frozen=True)
class Range:
    """What a number may be, or a text. ``low``/``high`` are inclusive; ``above`` is exclusive."""

    pattern: str
    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf
    options: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.options:
            return f"one of {', '.join(self.options)}"
        parts = []
        if self.above > -math.inf:
            parts.append(f"greater than {self.above:g}")
        if self.low > -math.inf:
            parts.append(f"at least {self.low:g}")
        if self.high < math.inf:
            parts.append(f"at most {self.high:g}")
        return " and ".join(parts) or "a finite number"

    def accepts(self, value: object) -> bool:
        """Whether ``value`` lies in the range; what is no number (or no text with options) is not judged."""
        if self.options:
            return not isinstance(value, str) or value in self.options
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return True
        return math.isfinite(value) and self.low <= value <= self.high and value > self.above


RANGES: tuple[Range, ...] = (
    Range("seed", low=0, high=2**32 - 1),
    Range("*.seed", low=0, high=2**32 - 1),
    Range("object.diameter", above=0, high=10),
    Range("object.units", options=("m", "cm", "mm", "inch")),
    Range("*workers", low=1, high=1024),
    Range("*batch_size", low=1),
    Range("*.lr", above=0, high=10),
    Range("*learning_rate", above=0, high=10),
    Range("*epochs", low=1),
    Range("*dropout", low=0, high=1),
    Range("*probability", low=0, high=1),
    Range("*_fraction", low=0, high=1),
    Range("*restitution", low=0, high=1),
    # Everything else that is a number is a count, a length, a weight or a rate: never negative.
    Range("*", low=0),
)

# Settings that may be negative: coordinates, angles and offsets.
SIGNED: tuple[str, ...] = ("object.symmetry.*", "*axis*", "*gravity*", "*offset*")


def range_of(key: str) -> Range:
    """The range of a dotted key."""
    if any(fnmatchcase(key, pattern) for pattern in SIGNED):
        return Range(key)
    return next(r for r in RANGES if fnmatchcase(key, r.pattern))


def violation(key: str, value: Any) -> str:
    """One sentence when ``value`` (a scalar or a list of them) is out of range, else an empty string."""
    allowed = range_of(key)
    for item in value if isinstance(value, list) else [value]:
        if not allowed.accepts(item):
            return f"{key} must be {allowed}; got {item!r}"
    return ""
