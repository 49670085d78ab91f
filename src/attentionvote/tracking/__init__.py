"""Experiment tracking: one thin logger on MLflow, the only place that knows MLflow.

``start_run`` opens or resumes a run, ``RunLogger`` hands it to ``lightning.Trainer(logger=...)``.
Importing this package imports neither MLflow nor Lightning: MLflow takes seconds and comes with the
first ``start_run``, Lightning with the first use of ``RunLogger``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from attentionvote.tracking.run import Run
from attentionvote.tracking.run_opening import start_run

if TYPE_CHECKING:
    from attentionvote.tracking.lightning_logger import RunLogger

__all__ = ["Run", "RunLogger", "start_run"]


def __getattr__(name: str) -> Any:
    if name == "RunLogger":
        from attentionvote.tracking.lightning_logger import RunLogger

        return RunLogger
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
