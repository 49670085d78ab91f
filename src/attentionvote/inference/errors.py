"""The cell's refusals, in one sentence each: bad input, a bundle it cannot trust, an answer that came too late."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

# Comparing takes time with the square of the length; no name that is served here is longer.
_LONGEST_NAME = 200


class InputError(ValueError):
    """What was sent or configured cannot be used: the caller must change it (HTTP 4xx, exit code 2)."""


class BundleError(ValueError):
    """A bundle, its signature or a key cannot be trusted or read: the operator must act (exit code 1)."""


class DeadlineExceeded(TimeoutError):
    """The work was stopped because its deadline had passed."""


class RegistryError(BundleError):
    """The registry gives no usable answer: it is away, refuses, or does not have what it is asked for (exit code 1).

    Attributes:
        away: whether asking again later may help: nothing answers, or it is overloaded.
    """

    def __init__(self, sentence: str, *, away: bool = False) -> None:
        super().__init__(sentence)
        self.away = away


def nearest(name: str, valid: Iterable[str], cutoff: float = 0.5) -> str:
    """``, did you mean 'x'?`` when one of the valid names is close, else nothing; at a cutoff of 0 one always is."""
    near = difflib.get_close_matches(name[:_LONGEST_NAME], list(valid), n=1, cutoff=cutoff)
    return f", did you mean {near[0]!r}?" if near else ""
