"""Farthest-point proposals against a slow loop, their marks, and the network with them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

from attentionvote.geometry.sampling import farthest_point_order
from attentionvote.model.farthest_votes import FarthestVotes, farthest_vote_peaks
from attentionvote.model.proposals import Peaks


def proposals(votes: Tensor, count: int) -> Peaks:
    return farthest_vote_peaks(votes, FarthestVotes()(votes, count))


def by_hand(votes: NDArray[np.float32], count: int) -> tuple[list[int], list[float]]:
    """Order and heat of one sample, distance by distance in float32."""
    order = [0]
    for _ in range(count - 1):
        least = []
        for vote in votes:
            squares = [(vote - votes[k]) ** 2 for k in order]
            least.append(min(np.float32(np.float32(s[0] + s[1]) + s[2]) for s in squares))
        order.append(max(range(len(votes)), key=lambda i: (least[i], -i)))
    chosen = [votes[k].tolist() for k in order]
    return order, [0.0 if seed in chosen[:k] else 1.0 for k, seed in enumerate(chosen)]


def scattered(seed: int, count: int, places: int) -> Tensor:
    """Two samples of votes at some ``places``: equal distances and equal places are the rule."""
    rng = np.random.default_rng(seed)
    corners = rng.integers(-4, 4, (2, places, 3)) * 2.0**-7 + rng.choice([0.0, 0.3], (2, 1, 3))
    votes = np.take_along_axis(corners, rng.integers(0, places, (2, count, 1)), axis=1)
    return torch.from_numpy(votes.astype(np.float32))


@settings(max_examples=40)
@given(st.integers(0, 2**31), st.integers(1, 24), st.integers(1, 40), st.integers(1, 12))
def test_order_and_marks_equal_a_loop_exactly(seed: int, count: int, places: int, wanted: int) -> None:
    votes, wanted = scattered(seed, count, places), min(wanted, count)
    order, peaks = FarthestVotes()(votes, wanted), proposals(votes, wanted)
    for i, sample in enumerate(votes.numpy()):
        expected, heat = by_hand(sample, wanted)
        assert order[i].tolist() == expected
        assert peaks.heat[i].tolist() == heat
        assert np.array_equal(peaks.center_seed[i], sample[expected])
        assert order[i].tolist() == farthest_point_order(sample, wanted).tolist()


def test_random_positions_give_the_same_order_as_the_loop() -> None:
    votes = torch.from_numpy(np.random.default_rng(0).normal(0, 0.1, (1, 60, 3)).astype(np.float32))
    assert FarthestVotes()(votes, 20)[0].tolist() == by_hand(votes[0].numpy(), 20)[0]


def test_every_cluster_of_votes_gets_a_proposal_before_any_gets_two() -> None:
    rng = np.random.default_rng(1)
    middles = np.array([[x, y, 0.5] for x in (0.0, 0.2, 0.4) for y in (0.0, 0.2)])
    votes = torch.from_numpy((middles[:, None] + rng.normal(0, 0.005, (6, 9, 3))).reshape(1, -1, 3)).float()
    seeds = proposals(votes, 6).center_seed[0].numpy()
    assert sorted(np.linalg.norm(seeds[:, None] - middles, axis=-1).argmin(1)) == list(range(6))


def test_places_beyond_the_distinct_votes_have_no_heat() -> None:
    votes = torch.tensor([[[0.0, 0, 0.5]] * 3 + [[0.1, 0, 0.5]] * 2])
    peaks = proposals(votes, 4)
    assert peaks.heat.tolist() == [[1.0, 1.0, 0.0, 0.0]]
    assert peaks.vote_heat.shape == (1, 5)


def test_the_network_proposes_votes_and_answers_a_sample_as_if_it_were_alone(
    make_network: Callable, make_cloud: Callable
) -> None:
    model, (points, normals) = make_network(1, proposal_source="fps", merge_fraction=0.1), make_cloud(3, 3, 96)
    with torch.no_grad():
        together = model(points, normals)
        for i in range(3):
            alone = model(points[i : i + 1], normals[i : i + 1])
            for a, b in zip(alone, together, strict=True):
                torch.testing.assert_close(b[i], a[0], rtol=1e-4, atol=1e-5)
            own = alone.vote_xyz[0]
            assert torch.equal(alone.center_seed[0], own[FarthestVotes()(own[None], 4)[0]])
    assert torch.equal(together.peak_heat, torch.ones(3, 4))


def test_more_proposals_than_votes_are_as_many_as_votes(make_network: Callable, make_cloud: Callable) -> None:
    model = make_network(proposal_source="fps", proposals=100)
    with torch.no_grad():
        assert model(*make_cloud(0, 1, 96)).center.shape == (1, model.layout.seeds, 3)


@pytest.mark.parametrize("device", ["cpu", "meta"])
def test_everything_is_computed_where_the_votes_are(device: str) -> None:
    # The meta device refuses tensors of another device, as a GPU does.
    votes = torch.zeros(2, 10, 3, device=device)
    assert {t.device.type for t in proposals(votes, 4)} == {device}
