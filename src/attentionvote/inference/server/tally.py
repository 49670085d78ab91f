"""Counts of answers by model, in the form of Triton's statistics."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

# Triton's names of the stages that are measured here.
_STAGES = {"queue": "queue", "compute_input": "parse", "compute_infer": "estimate"}


class Tally:
    """Counts requests by version of the model, since the server's start. Lives on the event loop."""

    def __init__(self) -> None:
        self._by_version: dict[str, _Counts] = {}

    def add(self, version: str, seconds: Mapping[str, float], *, answered: bool) -> None:
        """Count a request.

        Args:
            version: of the model that worked on it.
            seconds: by stage.
            answered: with poses or their absence; otherwise it was refused.
        """
        self._by_version.setdefault(version, _Counts()).add(seconds, answered)

    def statistics(self, name: str, version: str) -> dict[str, Any]:
        """An entry of ``model_stats``."""
        return {"name": name, "version": version, **self._by_version.get(version, _Counts()).statistics()}


class _Counts:
    def __init__(self) -> None:
        self._last_ms = 0
        self._sums = {key: [0, 0] for key in ("success", "fail", *_STAGES)}

    def add(self, seconds: Mapping[str, float], answered: bool) -> None:
        self._last_ms = int(time.time() * 1e3)
        self._count("success" if answered else "fail", sum(seconds.values()))
        if answered:
            for key, stage in _STAGES.items():
                self._count(key, seconds.get(stage, 0.0))

    def _count(self, key: str, seconds: float) -> None:
        self._sums[key][0] += 1
        self._sums[key][1] += round(seconds * 1e9)

    def statistics(self) -> dict[str, Any]:
        answered = self._sums["success"][0]
        return {
            "last_inference": self._last_ms,
            "inference_count": answered,
            "execution_count": answered,
            "inference_stats": {key: {"count": count, "ns": ns} for key, (count, ns) in self._sums.items()},
            "batch_stats": [],
        }
