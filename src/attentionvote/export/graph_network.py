"""The network as the exporter sees it: the same modules and weights, with neighbours found inside the graph.

Not a second network: ``ExportNetwork`` calls ``AttentionVote.forward`` itself. Only what a CPU runtime needs in
another order is replaced, layer by layer (``graph_layers``).
"""

from __future__ import annotations

import copy
from typing import TypeVar

from jaxtyping import Float
from torch import Tensor, nn

from attentionvote.export.graph_layers import GraphFarthestVotes, GraphHeatmap, GraphRefiner, GraphSetAbstraction
from attentionvote.export.graph_neighbors import find_neighborhoods
from attentionvote.model import AttentionVote, Predictions
from attentionvote.model.backbone import SetAbstraction
from attentionvote.model.refinement import Refiner

Kind = TypeVar("Kind", bound=nn.Module)


class ExportNetwork(nn.Module):
    """Points and normals in, poses out, nothing else needed: ``AttentionVote`` for a batch of one.

    Args:
        model: a trained network; its weights are shared, it is not changed.
    """

    def __init__(self, model: AttentionVote) -> None:
        super().__init__()
        model = _shallow(model)
        model.backbone = _shallow(model.backbone)
        model.backbone.abstractions = nn.ModuleList(
            GraphSetAbstraction(layer) for layer in _layers(model.backbone.abstractions, SetAbstraction)
        )
        model.refiners = nn.ModuleList(GraphRefiner(layer) for layer in _layers(model.refiners, Refiner))
        if model.farthest is not None:
            model.farthest = GraphFarthestVotes()
        model.heatmap = GraphHeatmap()
        self.model = model.eval()

    def forward(self, points: Float[Tensor, "1 points 3"], normals: Float[Tensor, "1 points 3"]) -> Predictions:
        """What ``AttentionVote.forward`` answers for the same cloud."""
        predictions: Predictions = self.model(points, normals, find_neighborhoods(points, self.model.layout))
        return predictions


def _layers(modules: nn.ModuleList, kind: type[Kind]) -> list[Kind]:
    """The modules of a list, which are all of one kind."""
    return [module for module in modules if isinstance(module, kind)]


def _shallow(module: Kind) -> Kind:
    """A module with the same weights whose children can be replaced without the original noticing."""
    twin = copy.copy(module)
    twin._modules = dict(module._modules)
    return twin
