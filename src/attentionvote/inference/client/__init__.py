"""A client of a cell's server: numpy and the standard library, nothing else."""

from attentionvote.inference.client.answer import (
    Answer,
    DeadlinePassed,
    PoseClientError,
    Rejected,
    ServerFailed,
    Unauthorized,
    Unavailable,
    Unreachable,
)
from attentionvote.inference.client.pose_client import PoseClient

__all__ = [
    "Answer",
    "DeadlinePassed",
    "PoseClient",
    "PoseClientError",
    "Rejected",
    "ServerFailed",
    "Unauthorized",
    "Unavailable",
    "Unreachable",
]
