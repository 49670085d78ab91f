"""What a sweep and the process of a trial agree on; knows neither torch nor Optuna.

A trial is an ordinary training. The sweep that starts it says so in one variable of the environment, because
whose trial it is does not belong to the settings of the training.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

VARIABLE = "ATTENTIONVOTE_TRIAL"
WORKER = "ATTENTIONVOTE_TRIAL_WORKER"  # where an executor's worker shall do it: the arguments of ``on_worker``
PRUNED_CODE = 3  # of a process whose trial was pruned
PRUNED_AT = "pruned_at_epoch"  # attribute of the trial: the decision stands, whatever happens to its process


def for_trial(url: str, study: str, number: int, heartbeat_s: int, pruner: Mapping[str, Any]) -> dict[str, str]:
    """The environment of a trial's process.

    Args:
        url, study: where the trial is kept.
        number: of the trial.
        heartbeat_s: see ``sweep_study.open_study``.
        pruner: arguments of ``sweep_study.make_pruner``.
    """
    about = {"url": url, "study": study, "number": number, "heartbeat_s": heartbeat_s, "pruner": dict(pruner)}
    return {VARIABLE: json.dumps(about)}


def on_worker(executor: str, cluster: Mapping[str, Any], threads: int, log: Path, script: Path) -> dict[str, str]:
    """What ``trial_job.py`` is told in its environment: where the training of a trial runs.

    Args:
        executor, cluster: see ``executor_named``.
        threads: cores of the trial.
        log: file for what the training says; on a disk that the worker sees.
        script: that trains.
    """
    about = {"executor": executor, "cluster": dict(cluster), "threads": threads}
    return {WORKER: json.dumps({**about, "log": str(log), "script": str(script)})}


def log_of(logs: Path, number: int) -> Path:
    """The file with what the training of a trial said."""
    return logs / f"trial_{number:03d}.log"
