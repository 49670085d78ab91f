"""Where the independent jobs of a verb run: its settings ``executor`` and ``cluster``."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig, OmegaConf

from attentionvote.execution import Executor, executor_named
from attentionvote.execution.hardware import cores


def executor_of(cfg: DictConfig) -> Executor:
    """The executor of a configuration.

    Raises:
        ValueError: when it cannot work here.
    """
    return executor_named(cfg.executor, cluster_of(cfg))


def cluster_of(cfg: DictConfig) -> dict[str, Any]:
    """The settings of the group ``cluster``, plain."""
    settings = OmegaConf.to_container(cfg.cluster, resolve=True)
    assert isinstance(settings, dict)
    return {str(key): value for key, value in settings.items()}


def cores_of_a_job(cfg: DictConfig, workers: int) -> int:
    """Cores each of ``workers`` jobs at a time may use: ``threads``, else this machine's, shared by jobs of its own."""
    return cfg.threads or max(1, cores() // (workers if cfg.executor == "local" else 1))
