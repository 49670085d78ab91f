"""Training: losses, schedule, the Lightning module, callbacks."""

from attentionvote.training.losses import AttentionVoteLoss, LossSettings
from attentionvote.training.module import PoseTraining
from attentionvote.training.schedule import Schedule

__all__ = ["AttentionVoteLoss", "LossSettings", "PoseTraining", "Schedule"]
