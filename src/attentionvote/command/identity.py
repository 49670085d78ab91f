"""Settings that do not change a result: left out where a configuration is identified."""

from __future__ import annotations

# What may change between two calls that mean the same training: it does not change what is learned.
NOT_IDENTITY = (
    *("resume", "force", "workers", "executor", "cluster", "tracking", "outputs", "root"),
    *("data.workers", "trainer.threads"),
)
