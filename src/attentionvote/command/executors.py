"""Where the independent jobs of a verb run: its settings ``executor`` and ``cluster``."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, Protocol

from attentionvote.command.sections import Cluster
from attentionvote.execution import Executor, executor_named
from attentionvote.execution.hardware import cores


class Placed(Protocol):
    """Settings that say where jobs run."""

    @property
    def executor(self) -> str:
        """See ``sections.EXECUTOR``."""

    @property
    def cluster(self) -> Cluster:
        """See ``sections.Cluster``."""


def executor_of(settings: Placed) -> Executor:
    """The executor of a verb's settings.

    Raises:
        ValueError: when it cannot work here.
    """
    return executor_named(settings.executor, cluster_of(settings))


def cluster_of(settings: Placed) -> dict[str, Any]:
    """The settings of the group ``cluster``, plain."""
    return asdict(settings.cluster)


def cores_of_a_job(threads: int | None, executor: str, workers: int) -> int:
    """Cores each of ``workers`` jobs at a time may use: ``threads``, else this machine's, shared by jobs of its own."""
    return threads or max(1, cores() // (workers if executor == "local" else 1))
