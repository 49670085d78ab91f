"""The network as the exporter sees it: the same modules and weights, with neighbours found inside the graph.

Not a second network: ``ExportNetwork`` calls ``AttentionVote.forward`` itself. Only what a CPU runtime needs in
another order is replaced, layer by layer (``graph_layers``).
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

from jaxtyping import Float, Int
from torch import Tensor, nn

from attentionvote.export import graph_layers
from attentionvote.export.graph_folding import GraphNorm, GraphVoteBranch, folded
from attentionvote.export.graph_neighbors import find_neighborhoods
from attentionvote.model.backbone import SetAbstraction
from attentionvote.model.farthest_votes import FarthestVotes
from attentionvote.model.fusion import VoteBranch
from attentionvote.model.layers import RowNorm
from attentionvote.model.network import AttentionVote
from attentionvote.model.predictions import Predictions
from attentionvote.model.proposals import Heatmap
from attentionvote.model.refinement import Refiner

_LAYERS: dict[type[nn.Module], Callable[[Any], nn.Module]] = {
    RowNorm: GraphNorm,
    nn.Sequential: folded,
    VoteBranch: GraphVoteBranch,
    SetAbstraction: graph_layers.GraphSetAbstraction,
    Refiner: graph_layers.GraphRefiner,
    FarthestVotes: lambda _: graph_layers.GraphFarthestVotes(),
    Heatmap: lambda _: graph_layers.GraphHeatmap(),
}


class ExportNetwork(nn.Module):
    """Points and normals in, poses out, nothing else needed: ``AttentionVote`` for a batch of one.

    Args:
        model: a trained network; it is not changed, and its weights are shared but for those that take up a norm.
    """

    def __init__(self, model: AttentionVote) -> None:
        super().__init__()
        shared = {id(tensor): tensor for tensor in (*model.parameters(), *model.buffers())}
        self.model = _replaced(copy.deepcopy(model, shared).eval())

    def forward(
        self,
        points: Float[Tensor, "1 points 3"],
        normals: Float[Tensor, "1 points 3"],
        *order_and_neighbors: Int[Tensor, "*sizes"],
    ) -> Predictions:
        """What ``AttentionVote.forward`` answers for the same cloud.

        Args:
            points, normals: as there.
            order_and_neighbors: see ``find_neighborhoods``.
        """
        predictions: Predictions = self.model(
            points, normals, find_neighborhoods(points, self.model.layout, order_and_neighbors)
        )
        return predictions


def _replaced(module: nn.Module) -> Any:
    """What stands for a module whose own layers are replaced first."""
    for name, child in list(module.named_children()):
        setattr(module, name, _replaced(child))
    stands_for = _LAYERS.get(type(module))
    return stands_for(module) if stands_for else module
