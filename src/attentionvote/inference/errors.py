"""What the cell refuses, in one sentence each: bad input, a bundle it cannot trust, an answer that came too late."""

from __future__ import annotations


class InputError(ValueError):
    """What was sent or configured cannot be used: the caller must change it (HTTP 4xx, exit code 2)."""


class BundleError(ValueError):
    """A bundle, its signature or a key cannot be trusted or read: the operator must act (exit code 1)."""


class DeadlineExceeded(TimeoutError):
    """The work was stopped because its deadline had passed."""
