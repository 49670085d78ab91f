"""The cores and GPUs that this process may use."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from attentionvote.execution.processor_quota import processor_quota

_GPUS = Path("/proc/driver/nvidia/gpus")  # a folder for each that this machine, or this container, has
_CAPABILITY_MAJOR = 75  # CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MAJOR of cuda.h


def cores() -> int:
    """Processor cores this process may use: of its cpuset, and of the quotas of its control groups (at least one).

    A fraction of a core is left out: a thread more than the quota pays for has all of them stopped for the rest of
    every period, and each operation waits for its last thread.
    """
    return max(1, int(min(len(os.sched_getaffinity(0)), processor_quota())))


def visible_gpus(environment: Mapping[str, str], present: Path = _GPUS) -> list[str]:
    """The GPUs that a process with this environment may use, as CUDA_VISIBLE_DEVICES names them; told without torch."""
    devices = environment.get("CUDA_VISIBLE_DEVICES")
    if devices is None:
        return [str(index) for index in range(len(list(present.iterdir())))] if present.is_dir() else []
    gpus: list[str] = []
    for name in (entry.strip() for entry in devices.split(",")):
        if name in ("", "-1"):
            break  # CUDA too sees none of what comes after the first that is no device
        gpus.append(name)
    return gpus


def gpu_of_slot(gpus: Sequence[str], slot: int) -> dict[str, str]:
    """The environment of the job in this slot among jobs side by side: each its own GPU, in turn where they are few.

    Args:
        gpus: see :func:`visible_gpus`; with fewer than two there is nothing to choose.
        slot: from 0; no two jobs that run have the same.
    """
    return {"CUDA_VISIBLE_DEVICES": gpus[slot % len(gpus)]} if len(gpus) > 1 else {}


def gpu_generation(driver: str = "libcuda.so.1") -> int | None:
    """Major number of the compute capability of the first NVIDIA GPU that this process may use; None without one.

    Told by the driver: torch would be imported for it, and would set up the device in a process that trains nothing.
    """
    try:
        library = ctypes.CDLL(driver)
    except OSError:
        return None
    device, value = ctypes.c_int(), ctypes.c_int()
    calls = [
        lambda: library.cuInit(0),
        lambda: library.cuDeviceGet(ctypes.byref(device), 0),
        lambda: library.cuDeviceGetAttribute(ctypes.byref(value), _CAPABILITY_MAJOR, device),
    ]
    return None if any(call() for call in calls) else value.value
