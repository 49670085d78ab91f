"""Cores that may be used, not cores that are there."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hardware import cores


def limited(monkeypatch: pytest.MonkeyPatch, allowed: int, quota: str | None) -> int:
    """Cores with a cpuset of ``allowed`` and a container's ``cpu.max`` of ``quota``."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(allowed)))

    def read_text(path: Path, *_: object) -> str:
        assert path == Path("/sys/fs/cgroup/cpu.max")
        if quota is None:
            raise FileNotFoundError(path)
        return quota

    monkeypatch.setattr(Path, "read_text", read_text)
    return cores()


@pytest.mark.parametrize(
    ("allowed", "quota", "expected"),
    [(8, None, 8), (8, "max 100000", 8), (8, "200000 100000", 2), (2, "800000 100000", 2), (4, "50000 100000", 1)],
)
def test_the_smaller_of_cpuset_and_quota_counts(
    monkeypatch: pytest.MonkeyPatch, allowed: int, quota: str | None, expected: int
) -> None:
    assert limited(monkeypatch, allowed, quota) == expected
