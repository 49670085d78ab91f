"""A sampler of the machine's load, light enough to run beside a training on two cores."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable

from attentionvote.tracking.provenance import query_gpus

GPU_FIELDS = {
    "utilization.gpu": "utilization_percent",
    "memory.used": "memory_used_mib",
    "temperature.gpu": "temperature_celsius",
    "power.draw": "power_watt",
}


def sample_system(has_gpu: bool) -> dict[str, float]:
    """Load since the last call: processor, memory (GiB), this process with its workers, disk, GPUs."""
    import psutil

    memory = psutil.virtual_memory()
    values = {
        "system/cpu_percent": psutil.cpu_percent(interval=None),
        "system/memory_percent": memory.percent,
        "system/memory_used_gib": (memory.total - memory.available) / 2**30,
        "system/disk_free_gib": psutil.disk_usage(os.getcwd()).free / 2**30,
    }
    process = psutil.Process()
    resident = process.memory_info().rss
    for child in process.children(recursive=True):
        with contextlib.suppress(psutil.Error):  # a worker may end while we look
            resident += child.memory_info().rss
    values["system/process_memory_gib"] = resident / 2**30
    if has_gpu:
        for index, row in enumerate(query_gpus(",".join(GPU_FIELDS))):
            for name, cell in zip(GPU_FIELDS.values(), row, strict=True):
                with contextlib.suppress(ValueError):  # "[N/A]" on some boards
                    values[f"system/gpu_{index}_{name}"] = float(cell)
    return values


class SystemSampler:
    """Calls ``add(metrics, step)`` every ``interval_s`` from a thread; the step counts samples."""

    def __init__(self, add: Callable[[dict[str, float], int], None], first_step: int, interval_s: float) -> None:
        self._add, self._step, self._interval_s = add, first_step, interval_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._sample_forever, name="system-metrics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the thread."""
        self._stop.set()
        self._thread.join(timeout=1.0)

    def _sample_forever(self) -> None:
        has_gpu = bool(query_gpus("name"))
        while not self._stop.wait(self._interval_s):
            with contextlib.suppress(Exception):  # the sampler is a convenience: it never disturbs
                self._add(sample_system(has_gpu), self._step)
                self._step += 1
