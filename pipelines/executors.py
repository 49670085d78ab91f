"""Where the independent jobs of a verb run: its settings ``executor`` and ``cluster``."""

from __future__ import annotations

from omegaconf import DictConfig, OmegaConf

from attentionvote.execution import Executor, executor_named


def executor_of(cfg: DictConfig) -> Executor:
    """The executor of a configuration.

    Raises:
        ValueError: when it cannot work here.
    """
    settings = OmegaConf.to_container(cfg.cluster, resolve=True)
    assert isinstance(settings, dict)
    return executor_named(cfg.executor, {str(key): value for key, value in settings.items()})
