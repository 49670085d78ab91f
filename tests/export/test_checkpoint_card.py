"""The card of a network that is used otherwise than its training's test used it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from attentionvote.contract import ModelCard
from attentionvote.export.checkpoint_card import model_card, used_otherwise
from attentionvote.model.network import AttentionVote
from attentionvote.part import Part

VOLUME = ((0.4, 0.7), 0.2)
Card = Callable[..., ModelCard]


@pytest.fixture
def make_card(
    part: Part, make_network: Callable[[int], AttentionVote], make_metadata: Callable[..., dict[str, Any]]
) -> Card:
    """Card of the small network after ``used_otherwise``."""

    def make(voting_radius: float | None = None, peak_threshold: float | None = None) -> ModelCard:
        network = make_network(0)
        return model_card(
            network, used_otherwise(network, make_metadata(), voting_radius, peak_threshold), part, *VOLUME
        )

    return make


def test_without_changes_the_card_is_the_trainings(make_card: Card) -> None:
    card = make_card()
    assert (card.voting_radius, card.peak_threshold, card.evaluation) == (None, 0.05, {"ap_10": 0.5})


def test_another_radius_is_on_the_card_and_the_tests_figures_are_not(make_card: Card) -> None:
    card = make_card(voting_radius=0.011)
    assert (card.voting_radius, card.peak_threshold, card.evaluation) == (0.011, 0.05, {})
    assert card.confidence_threshold == 0.1


def test_another_threshold_is_on_the_card_and_the_tests_figures_are_not(make_card: Card) -> None:
    card = make_card(peak_threshold=0.3)
    assert (card.voting_radius, card.peak_threshold, card.evaluation) == (None, 0.3, {})


def test_what_the_training_has_already_changes_nothing(
    make_card: Card, make_network: Callable[[int], AttentionVote]
) -> None:
    assert make_card(make_network(0).voting_radius, 0.05) == make_card()


def test_a_networks_own_test_radius_is_on_its_card(
    part: Part, make_network: Callable[[int], AttentionVote], make_metadata: Callable[..., dict[str, Any]]
) -> None:
    network, metadata = make_network(0), make_metadata()
    network.test_voting_radius = 0.011
    assert model_card(network, metadata, part, *VOLUME).voting_radius == 0.011
    # Exported as it was tested: the figures hold. Back at the training's radius: they do not.
    assert used_otherwise(network, metadata, 0.011, None) == metadata
    changed = used_otherwise(network, metadata, network.voting_radius, None)
    assert (changed["test"], network.test_voting_radius) == ({}, network.voting_radius)
    assert model_card(network, changed, part, *VOLUME).voting_radius is None


def test_a_threshold_that_no_farthest_vote_passes_is_refused(make_metadata: Callable[..., dict[str, Any]]) -> None:
    metadata = make_metadata()
    network = AttentionVote.from_arguments(metadata["model"] | {"proposal_source": "fps"})
    assert used_otherwise(network, metadata, None, 1.0)["peak_threshold"] == 1.0
    with pytest.raises(ValueError, match=r"must be at most 1, the heat of all farthest-point proposals, got 1\.5"):
        used_otherwise(network, metadata, None, 1.5)
