"""The model card: complete, canonical, and a text that is none is one sentence."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.contract import ModelCard, PartCard, TensorSpec, is_detection

PART = PartCard(
    name="bracket",
    title="a bracket",
    diameter=0.1,
    digest="0" * 64,
    symmetry={"kind": "cyclic", "order": 2, "axis": (0.0, 0.0, 1.0)},
    box=((-0.05, -0.02, -0.01), (0.05, 0.02, 0.01)),
)
CARD = ModelCard(
    part=PART,
    classes=("bracket", "other"),
    points=256,
    votes=64,
    proposals=4,
    density=2000,
    normal_neighbors=30,
    peak_threshold=0.4,
    confidence_threshold=0.5,
    distance=(0.6, 1.0),
    extent=0.43,
    data={"test": "abc"},
    run_id="run",
    commit="c0ffee+dirty",
    versions={"torch": "2"},
    parity={"translation_mm": 0.01, "table": [{"path": "cpu"}]},
    evaluation={"ap": 0.9},
)


def changed(**changes: Any) -> str:
    """The card's JSON with other fields; ``part`` takes changes of the part."""
    content = json.loads(CARD.to_json())
    content["part"] |= changes.pop("part", {}) if isinstance(changes.get("part"), dict) else {}
    return json.dumps(content | changes)


def test_a_card_comes_back_from_its_text() -> None:
    back = ModelCard.from_json(CARD.to_json())
    assert back.to_json() == CARD.to_json()
    assert back.part.box == PART.box
    assert back.classes == CARD.classes
    assert back.distance == CARD.distance
    assert replace(back, part=replace(back.part, symmetry=PART.symmetry)) == CARD


@given(
    st.lists(st.text(max_size=5), min_size=1, max_size=3),
    st.floats(1e-3, 1e3),
    st.floats(1e-3, 10),
    st.integers(1, 10**6),
    st.dictionaries(
        st.text(max_size=5), st.none() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=5)
    ),
)
def test_any_card_comes_back_from_its_text(
    classes: list[str], near: float, more: float, count: int, figures: dict[str, Any]
) -> None:
    card = replace(CARD, classes=tuple(classes), distance=(near, near + more), votes=count, evaluation=figures)
    assert ModelCard.from_json(card.to_json()).to_json() == card.to_json()


def test_whole_and_numpy_numbers_give_the_same_text() -> None:
    # The graph carries the text that was written, the cell compares it with the one it reads.
    card = replace(CARD, distance=(1, 2), extent=np.float32(1), peak_threshold=0, confidence_threshold=np.float64(0.5))  # type: ignore[arg-type]
    same = replace(CARD, distance=(1.0, 2.0), extent=1.0, peak_threshold=0.0)
    assert card.to_json() == same.to_json() == ModelCard.from_json(card.to_json()).to_json()
    box = replace(PART, box=np.array(PART.box), diameter=np.float64(0.1))  # type: ignore[arg-type]
    assert box == PART


def test_the_text_is_canonical() -> None:
    content = json.loads(CARD.to_json())
    assert content["contract_version"] == 1
    assert content["units"] == "m"
    assert list(content) == sorted(content)
    other = replace(CARD, parity=dict(reversed(CARD.parity.items())))
    assert other.to_json() == CARD.to_json()


def test_the_core_is_what_is_known_before_measuring() -> None:
    core = CARD.core()
    assert (core.parity, core.evaluation) == ({}, {})
    assert replace(core, parity=CARD.parity, evaluation=CARD.evaluation) == CARD
    assert core.core() == core


def test_the_tensors_follow_from_the_card() -> None:
    assert CARD.inputs == (TensorSpec("points", (1, 256, 3)), TensorSpec("normals", (1, 256, 3)))
    assert CARD.outputs == (
        ("vote_xyz", (1, 64, 3)),
        ("center_seed", (1, 4, 3)),
        ("peak_heat", (1, 4)),
        ("center", (1, 4, 3)),
        ("quaternion", (1, 4, 4)),
        ("class_logits", (1, 4, 2)),
        ("confidence", (1, 4)),
    )


def test_the_outputs_are_the_networks() -> None:
    from attentionvote.model.predictions import Predictions

    assert tuple(spec.name for spec in CARD.outputs) == Predictions._fields


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "a model card must be JSON, got a text that is none"),
        ("{", "must be JSON"),
        ("[" * 100_000, "must be JSON"),
        (changed().replace('"extent": 0.43', '"extent": NaN'), r"must be JSON, .* \(NaN is no JSON\)"),
        ("[]", "must be a JSON object, got list"),
        ("{}", "must have contract_version 1, got None: export the model again with this version"),
        (changed(contract_version=2), "must have contract_version 1, got 2"),
        (changed(contract_version=True), "must have contract_version 1, got True"),
        (changed(units="mm"), "must have units 'm', got 'mm'"),
        (changed(frame="OpenGL"), "must have frame 'camera: x right, y down, z forward .OpenCV.', got 'OpenGL'"),
        (changed(more=1), "card must have the fields part, classes, .*'more'"),
        (changed(part=1), "card part must have the fields name, .*; got int"),
        (changed(part={"more": 1}), "card part must have the fields name, .*'more'"),
        (changed(part={"name": ""}), "card part.name must not be empty"),
        (changed(part={"name": 5}), "card part.name must be a text, got 5"),
        (changed(part={"digest": None}), "card part.digest must be a text, got None"),
        (changed(part={"diameter": 0}), "card part.diameter must be positive metres, got 0"),
        (changed(part={"diameter": "0.1"}), "card part.diameter must be a finite number, got '0.1'"),
        (changed(part={"symmetry": []}), r"card part.symmetry must be the arguments of a symmetry, got \[\]"),
        (changed(part={"box": 5}), "card part.box must be two corners of three numbers, got 5"),
        (changed(part={"box": [[0, 0], [1, 1]]}), "card part.box must be a lowest and a highest corner"),
        (changed(part={"box": [[0, 0, 0], [1, 1, 0]]}), "card part.box must be a lowest and a highest corner"),
        (changed(part={"box": [["a"] * 3] * 2}), "card part.box must be two corners"),
        (changed(classes=[]), r"card classes must name at least one class, got \[\]"),
        (changed(classes="bracket"), "card classes must name at least one class, got 'bracket'"),
        (changed(classes=[1]), "card classes must be a text, got 1"),
        (changed(points=0), "card points must be a whole number of at least 1, got 0"),
        (changed(votes=True), "card votes must be a whole number of at least 1, got True"),
        (changed(proposals=1.5), "card proposals must be a whole number of at least 1, got 1.5"),
        (changed(density="many"), "card density must be a whole number of at least 1, got 'many'"),
        (changed(normal_neighbors=None), "card normal_neighbors must be a whole number"),
        (changed(peak_threshold=-1), "card peak_threshold must be a number of at least 0, got -1"),
        (changed(confidence_threshold=None), "card confidence_threshold must be a finite number, got None"),
        (changed(distance=[1]), r"card distance must be two lengths, nearest and farthest, got \[1\]"),
        (changed(distance=1), "card distance must be two lengths"),
        (changed(distance=[1, 1]), r"card distance must be a rising range, got \[1.0, 1.0\]"),
        (changed(distance=[0, 1]), "card distance must be positive metres, got 0"),
        (changed(extent=[]), r"card extent must be a finite number, got \[\]"),
        (changed(run_id=None), "card run_id must be a text, got None"),
        (changed(versions=[]), r"card versions must be values by name, got \[\]"),
        (changed(evaluation=3), "card evaluation must be values by name, got 3"),
    ],
)
def test_a_text_that_is_no_card_is_one_sentence(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        ModelCard.from_json(text)
    assert "\n" not in str(caught.value)


def test_a_voting_radius_is_on_the_card_only_where_it_differs() -> None:
    assert "voting_radius" not in CARD.to_json()
    other = replace(CARD, voting_radius=0.008)
    assert ModelCard.from_json(other.to_json()).voting_radius == 0.008
    assert other.core().voting_radius == 0.008  # the graph carries it
    with pytest.raises(ValueError, match="card voting_radius must be positive metres, got -1"):
        replace(CARD, voting_radius=-1)


@pytest.mark.parametrize("name", [f.name for f in fields(ModelCard) if f.name not in ("voting_radius", "parts")])
def test_every_field_is_needed(name: str) -> None:
    content = json.loads(CARD.to_json())
    del content[name]
    with pytest.raises(ValueError, match="card must have the fields"):
        ModelCard.from_json(json.dumps(content))


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-3, 3) | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)


@given(st.sampled_from([f.name for f in fields(ModelCard)]), st.sampled_from([f.name for f in fields(PartCard)]), JSON)
def test_no_value_raises_anything_else(name: str, part: str, value: Any) -> None:
    for text in (changed(**{name: value}), changed(part={part: value})):
        try:
            ModelCard.from_json(text)
        except ValueError as error:
            assert str(error)  # noqa: PT017


def test_a_detection_has_heat_and_confidence_and_zero_is_never_enough() -> None:
    heat = np.array([0.4, 0.39, 0.0, 0.5, 0.5, np.nan])
    confidence = np.array([0.5, 0.9, 0.9, 0.49, 0.0, 0.9])
    np.testing.assert_array_equal(is_detection(heat, confidence, 0.4, 0.5), [True, False, False, False, False, False])
    np.testing.assert_array_equal(is_detection(heat, confidence, 0.0, 0.0), [True, True, False, True, False, False])
