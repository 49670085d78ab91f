"""Cores that may be used, not cores that are there."""

from __future__ import annotations

import ctypes
import math
import os
from pathlib import Path
from typing import Any

import pytest

from attentionvote.execution import hardware
from attentionvote.execution.hardware import cores, gpu_of_slot, visible_gpus


@pytest.mark.parametrize(
    ("allowed", "quota", "expected"), [(8, math.inf, 8), (8, 2.0, 2), (2, 8.0, 2), (8, 3.99, 3), (4, 0.5, 1)]
)
def test_the_smaller_of_cpuset_and_quota_counts(
    monkeypatch: pytest.MonkeyPatch, allowed: int, quota: float, expected: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(allowed)))
    monkeypatch.setattr(hardware, "processor_quota", lambda: quota)
    assert cores() == expected


@pytest.mark.parametrize(
    ("said", "there", "expected"),
    [
        (None, 0, []),
        (None, 3, ["0", "1", "2"]),
        ("2,5", 8, ["2", "5"]),
        ("GPU-8a, MIG-7b", 8, ["GPU-8a", "MIG-7b"]),
        ("1,-1,0", 8, ["1"]),
        ("", 8, []),
    ],
)
def test_the_gpus_of_a_machine_without_asking_torch(
    tmp_path: Path, said: str | None, there: int, expected: list[str]
) -> None:
    for index in range(there):
        (tmp_path / "gpus" / f"0000:{index:02x}:00.0").mkdir(parents=True)
    environment = {} if said is None else {"CUDA_VISIBLE_DEVICES": said}
    assert visible_gpus(environment, tmp_path / "gpus") == expected


def test_jobs_side_by_side_have_gpus_of_their_own_as_long_as_there_are_some() -> None:
    chosen = [gpu_of_slot(["2", "5", "7"], slot) for slot in range(5)]
    assert [c["CUDA_VISIBLE_DEVICES"] for c in chosen] == ["2", "5", "7", "2", "5"]
    assert gpu_of_slot(["2"], 1) == gpu_of_slot([], 1) == {}


class Driver:
    """libcuda of a machine with one GPU, or with none that this process may use."""

    def __init__(self, major: int, error: int = 0) -> None:
        self.major, self.error = major, error

    def cuInit(self, _: int) -> int:
        return 0

    def cuDeviceGet(self, _: Any, index: int) -> int:
        assert index == 0
        return self.error

    def cuDeviceGetAttribute(self, value: Any, attribute: int, _: Any) -> int:
        assert attribute == 75
        value._obj.value = self.major
        return 0


def test_the_generation_of_the_gpu_without_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    assert hardware.gpu_generation("libno-such-driver.so") is None
    monkeypatch.setattr(ctypes, "CDLL", lambda _: Driver(9))
    assert hardware.gpu_generation() == 9
    monkeypatch.setattr(ctypes, "CDLL", lambda _: Driver(9, error=101))  # CUDA_VISIBLE_DEVICES hides it
    assert hardware.gpu_generation() is None
