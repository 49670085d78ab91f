"""Export of a model of several parts: its card from the checkpoint, and the proof, part by part."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from attentionvote.evaluation import SceneResult
from attentionvote.export.checkpoint_card import model_card
from attentionvote.export.parity import compare
from attentionvote.geometry.pose import rotation_about, transform
from attentionvote.model.network import AttentionVote
from attentionvote.part import Part, PartSet


def facts(part: Part | PartSet) -> dict[str, Any]:
    """What a checkpoint keeps of it."""
    kept = {"name": part.name, "title": part.title, "diameter": part.diameter, "digest": part.digest}
    return kept | ({"symmetry": asdict(part.symmetry)} if isinstance(part, Part) else {})


def scene(kinds: list[int], turn_degrees: float = 0.0, called: list[int] | None = None) -> SceneResult:
    """Parts 0.2 m apart, found where they are, turned about their z axes."""
    truth = np.stack([transform(np.eye(3), [0.2 * i, 0, 0.8]) for i in range(len(kinds))])
    found = truth @ transform(rotation_about([0, 0, 1], np.radians(turn_degrees)), np.zeros(3))
    return SceneResult(found, np.full(len(kinds), 0.9), truth, np.zeros(len(kinds)), called or kinds, kinds)


def test_answers_are_compared_part_by_part_with_their_own_symmetry(box_and_slab: PartSet) -> None:
    same = compare([scene([0, 1, 1])], [scene([0, 1, 1])], box_and_slab, 0.5)
    assert (same.pairs, same.unmatched, same.rotation_degrees) == (3, 0, 0.0)
    assert same.ap["ap_10"] == (1.0, 1.0)
    slabs = compare([scene([1, 1])], [scene([1, 1], 180.0)], box_and_slab, 0.5)
    assert (slabs.pairs, slabs.unmatched) == (2, 0)
    assert slabs.rotation_degrees < 1e-4, "half a turn leaves a slab what it is"
    boxes = compare([scene([0, 0])], [scene([0, 0], 180.0)], box_and_slab, 0.5)
    assert boxes.pairs == 0 or boxes.rotation_degrees > 100


def test_another_name_is_a_detection_without_a_partner(box_and_slab: PartSet) -> None:
    parity = compare([scene([0, 1])], [scene([0, 1], called=[0, 0])], box_and_slab, 0.5)
    assert (parity.pairs, parity.unmatched, parity.unmatched_scenes) == (1, 2, (0,))
    assert parity.ap["ap_10"][0] == 1.0 > parity.ap["ap_10"][1]


def test_the_card_names_every_part_and_the_box_of_all(box_and_slab: PartSet, network: AttentionVote) -> None:
    metadata: dict[str, Any] = {
        "part": facts(box_and_slab), "parts": [facts(part) for part in box_and_slab.parts], "points": 256,
        "clouds": {"density": 2000, "neighbors": 30}, "peak_threshold": 0.4, "confidence_threshold": 0.5,
        "data": {}, "test": {"ap_10": 0.9, "slab/ap_10": 0.8},
    }  # fmt: skip
    card = model_card(network, metadata, box_and_slab, (0.5, 0.9), 0.4)
    assert card.classes == ("box", "slab")
    assert [part.digest for part in card.parts] == [part.digest for part in box_and_slab.parts]
    assert [part.symmetry["kind"] for part in card.each_part] == ["none", "cyclic"]
    assert (card.part.name, card.part.digest, card.part.diameter) == ("box_and_slab", box_and_slab.digest, 0.096)
    np.testing.assert_allclose(card.part.box, [[-0.045, -0.02, -0.01], [0.045, 0.02, 0.01]])
    other = PartSet("box_and_slab", box_and_slab.parts[::-1])
    with pytest.raises(ValueError, match="the checkpoint must be of box_and_slab as it is now, got one of other parts"):
        model_card(network, metadata, other, (0.5, 0.9), 0.4)
