"""What the cell refuses, in one sentence each: bad input, a bundle it cannot trust, an answer that came too late."""

from __future__ import annotations


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
