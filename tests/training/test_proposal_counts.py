"""Proposals counted on instances, against a slow loop and by hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from attentionvote.data.samples import Batch
from attentionvote.model.predictions import Predictions
from attentionvote.training.proposal_counts import ProposalCounts, proposal_counts, proposal_figures


def answers(seed: Tensor, heat: Tensor) -> Predictions:
    """Proposals at centre seeds; their poses do not matter."""
    batch, k, _ = seed.shape
    rest = torch.zeros(batch, k, 4), torch.zeros(batch, k, 1), torch.zeros(batch, k)
    return Predictions(torch.zeros(batch, 5, 3), seed, heat, torch.full_like(seed, 9.0), *rest)


def by_hand(seed: np.ndarray, center: np.ndarray, visible: np.ndarray, radius: float) -> ProposalCounts:
    owners: dict[int, int] = {}
    strays = 0
    for s in seed:
        distances = {i: float(np.linalg.norm(s - c)) for i, c in enumerate(center) if visible[i] > 0}
        nearest = min(distances, key=lambda i: distances[i]) if distances else None
        if nearest is None or distances[nearest] >= radius:
            strays += 1
        else:
            owners[nearest] = owners.get(nearest, 0) + 1
    required = [i for i in range(len(center)) if visible[i] >= 0.5]
    return ProposalCounts(
        len(seed), len(required), sum(i in owners for i in required), sum(n - 1 for n in owners.values()), strays
    )


@settings(max_examples=40)
@given(seed=st.integers(0, 2**31))
def test_counts_equal_a_loop(make_scenes: Callable[..., Batch], seed: int) -> None:
    rng, batch = np.random.default_rng(seed), make_scenes(3, 1, 0)
    visible = torch.from_numpy(rng.choice([0.0, 0.3, 0.5, 1.0], (3, 3))).float() * (batch.visible > 0)
    batch = batch._replace(visible=visible)
    at = batch.center[:, rng.integers(0, 3, 8)].numpy() + rng.normal(0, 0.02, (3, 8, 3))
    heat = rng.choice([0.0, 0.3, 0.5], (3, 8))
    predictions = answers(torch.from_numpy(at).float(), torch.from_numpy(heat).float())
    counts = proposal_counts(predictions, batch, 0.4, 0.02)
    for i, found in enumerate(counts):
        kept = predictions.center_seed[i][torch.from_numpy(heat[i] >= 0.4)].double().numpy()
        assert found == by_hand(kept, batch.center[i].double().numpy(), visible[i].numpy(), 0.02)


@pytest.fixture
def batch(make_scenes: Callable[..., Batch]) -> Batch:
    """Three boxes 70 mm apart, one of them hardly visible."""
    return make_scenes(3)._replace(visible=torch.tensor([[1.0, 0.2, 0.5]]))


def test_an_omission_a_repetition_and_a_stray_by_hand(batch: Batch) -> None:
    first, hidden, third = batch.center[0]
    away = torch.tensor([0.0, 0.0, 0.0115])
    # Two on the first, one on the hidden one, none on the third: 20 mm beside it is none.
    seed = torch.stack([first, first + away, hidden - away, third + 2 * away, third])[None]
    (found,) = proposal_counts(answers(seed, torch.tensor([[1.0, 1.0, 1.0, 1.0, 0.0]])), batch, 0.0, 0.02)
    assert found == ProposalCounts(proposals=4, required=2, proposed=1, repeats=1, strays=1)
    assert proposal_figures([found]) == {
        "proposal_recall": 0.5, "proposal_repeats": 1.0, "proposal_strays": 1.0, "proposal_count": 4.0,
    }  # fmt: skip


def test_a_proposal_between_two_instances_covers_the_nearer_one_only(batch: Batch) -> None:
    seed = (0.6 * batch.center[0, 0] + 0.4 * batch.center[0, 2])[None, None]
    batch = batch._replace(visible=torch.tensor([[1.0, 0.0, 1.0]]))
    (found,) = proposal_counts(answers(seed, torch.ones(1, 1)), batch, 0.0, 0.1)
    assert (found.required, found.proposed, found.repeats, found.strays) == (2, 1, 0, 0)


def test_figures_are_over_all_scenes_and_absent_where_nothing_is_required() -> None:
    counts = [ProposalCounts(5, 4, 3, 1, 0), ProposalCounts(2, 0, 0, 0, 2), ProposalCounts(0, 4, 0, 0, 0)]
    assert proposal_figures(counts) == {
        "proposal_recall": 3 / 8, "proposal_repeats": 1.0, "proposal_strays": 2.0, "proposal_count": 7.0,
    }  # fmt: skip
    assert "proposal_recall" not in proposal_figures(counts[1:2])
    assert proposal_figures([]) == {}
