"""All of it together: the losses teach a small network one scene by heart."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from attentionvote.data.samples import collate
from attentionvote.evaluation import PoseMetric, average_precision
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.training.detections import scene_results
from attentionvote.training.losses import AttentionVoteLoss
from attentionvote.training.settings import LossSettings
from attentionvote.training.step import batch_loss

WEIGHTS = {"vote": 2.0, "vote_rotation": 0.5, "center": 1.0, "rotation": 1.0, "confidence": 1.0, "refined": 1.0}


@pytest.mark.slow
def test_a_small_network_learns_one_scene_of_three_instances(
    make_box: Callable, make_network: Callable, make_sample: Callable
) -> None:
    part, model = make_box(Symmetry("dihedral", order=2)), make_network().train()
    batch = collate([make_sample(3, 3)])
    loss = AttentionVoteLoss(part, WEIGHTS, LossSettings())
    optimizer = torch.optim.Adam(model.parameters(), lr=3e-3)
    history = []
    for step in range(200):
        terms = batch_loss(model, loss, batch, ramp=0.0 if step < 40 else 1.0, least_heat=0.1)
        total = loss.total(terms)
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        history.append({k: v.item() for k, v in terms.items()})
    model.eval()
    with torch.no_grad():
        result = scene_results(model(batch.points, batch.normals, batch.neighborhoods), batch, peak_threshold=0.4)
    assert history[-1]["vote"] < 0.2 * history[0]["vote"]
    # The first values of the proposals' terms are those of step 40.
    assert history[-1]["refined"] < 0.5 * history[40]["refined"]
    scores = average_precision(result, PoseMetric.of(part), 0.1 * part.diameter)
    assert (len(result[0].gt_poses), scores.ap) == (3, pytest.approx(1.0))
    # Confidence tells right from wrong: the best three are the right ones.
    best = np.argsort(-result[0].scores)[:3]
    nearest = PoseMetric.of(part).distances(result[0].poses[best], result[0].gt_poses).argmin(1)
    assert sorted(nearest) == [0, 1, 2]
