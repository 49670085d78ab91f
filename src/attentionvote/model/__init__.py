"""The network, plain torch: point operations, backbone, votes, proposals, attention fusion, refinement."""

from attentionvote.model.neighborhoods import Layout, Neighborhoods, find_neighborhoods
from attentionvote.model.network import AttentionVote
from attentionvote.model.predictions import Poses, Predictions, Votes
from attentionvote.model.proposals import Peaks

__all__ = ["AttentionVote", "Layout", "Neighborhoods", "Peaks", "Poses", "Predictions", "Votes", "find_neighborhoods"]
