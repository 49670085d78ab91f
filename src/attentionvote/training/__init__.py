"""Training: losses, schedule, the Lightning module, callbacks.

The public names are loaded on first use, so that reading a checkpoint does not import Lightning.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from attentionvote.training.losses import AttentionVoteLoss, LossSettings
    from attentionvote.training.module import PoseTraining
    from attentionvote.training.schedule import Schedule

__all__ = ["AttentionVoteLoss", "LossSettings", "PoseTraining", "Schedule"]

_MODULE_OF = {
    "AttentionVoteLoss": "losses",
    "LossSettings": "losses",
    "PoseTraining": "module",
    "Schedule": "schedule",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
