"""The preset of a training by the hardware that trains."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from attentionvote.workflows.train.processes import TrainingProcess, be_silent, refuse_grid
from attentionvote.workflows.train.settings import TrainSettings

log = logging.getLogger("attentionvote.train")


def preset_of_hardware(words: list[str]) -> list[str]:
    """``experiment=gpu`` where torch can use a GPU, else ``experiment=compact``, unless the user named one.

    Told without importing torch: an NVIDIA driver is loaded, not hidden from us, and torch is no CPU build.
    """
    process = TrainingProcess.of(os.environ)
    refuse_grid(process, sys.argv)
    if process.local_rank:
        be_silent()  # what is wrong with the words is said once a machine
    if any(word.lstrip("+~").startswith("experiment") for word in words):
        return []
    preset, reason = "compact", "no GPU was found"
    if Path("/proc/driver/nvidia/version").exists():
        preset, reason = "gpu", "a GPU was found"
        if os.environ.get("CUDA_VISIBLE_DEVICES") in ("", "-1"):
            preset, reason = "compact", "CUDA_VISIBLE_DEVICES hides the GPU"
        elif version("torch").endswith("+cpu"):
            preset, reason = "compact", "torch is a CPU build"
    if process.rank == 0:
        log.info("experiment=%s, because %s (experiment=... chooses another)", preset, reason)
    return [f"experiment={preset}"]


def preset_of_workers(cfg: TrainSettings, words: Sequence[str]) -> list[str]:
    """The preset of the machines that train: of this one, or on a cluster what the jobs are given.

    The machine that submits says nothing about those that train: a cluster's jobs have a GPU when they ask for one.
    """
    if cfg.executor == "local" or any(word.lstrip("+~").startswith("experiment") for word in words):
        return preset_of_hardware(list(words))
    preset = "gpu" if cfg.cluster.gpus > 0 else "compact"
    log.info("experiment=%s, because cluster.gpus=%s (experiment=... chooses another)", preset, cfg.cluster.gpus)
    return [f"experiment={preset}"]
