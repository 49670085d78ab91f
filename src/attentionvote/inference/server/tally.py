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
        self._sums: dict[str, dict[str, list[int]]] = {}  # by version and key: count and nanoseconds
        self._last_ms: dict[str, int] = {}

    def add(self, version: str, seconds: Mapping[str, float], *, answered: bool) -> None:
        """Count a request.

        Args:
            version: of the model that worked on it.
            seconds: by stage.
            answered: with poses or their absence; otherwise it was refused.
        """
        spent: dict[str, float] = {"success" if answered else "fail": sum(seconds.values())}
        if answered:
            spent |= {key: seconds.get(stage, 0.0) for key, stage in _STAGES.items()}
        sums = self._sums.setdefault(version, _zeros())
        for key, value in spent.items():
            sums[key][0] += 1
            sums[key][1] += round(value * 1e9)
        self._last_ms[version] = int(time.time() * 1e3)

    def statistics(self, name: str, version: str) -> dict[str, Any]:
        """An entry of ``model_stats``."""
        sums = self._sums.get(version, _zeros())
        answered = sums["success"][0]
        return {
            "name": name,
            "version": version,
            "last_inference": self._last_ms.get(version, 0),
            "inference_count": answered,
            "execution_count": answered,
            "inference_stats": {key: {"count": count, "ns": ns} for key, (count, ns) in sums.items()},
            "batch_stats": [],
        }


def _zeros() -> dict[str, list[int]]:
    return {key: [0, 0] for key in ("success", "fail", *_STAGES)}
