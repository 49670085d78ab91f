"""The card is found in real graphs, and no bytes make the walk raise anything but ValueError or never end."""

from __future__ import annotations

import random
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.contract import CARD_KEY, ModelCard
from attentionvote.inference.bundles.graph_card import card_text


def test_the_card_is_what_onnx_reads(make_card: Callable[..., ModelCard], make_graph: Callable[..., Any]) -> None:
    model = make_graph(make_card())
    by_onnx = {entry.key: entry.value for entry in model.metadata_props}[CARD_KEY]
    assert card_text(model.SerializeToString()) == by_onnx == make_card().core().to_json()


def test_a_graph_without_metadata_has_no_card(
    make_card: Callable[..., ModelCard], make_graph: Callable[..., Any]
) -> None:
    assert card_text(make_graph(make_card(), metadata=False).SerializeToString()) is None


def test_an_empty_value_is_a_text(make_card: Callable[..., ModelCard], make_graph: Callable[..., Any]) -> None:
    model = make_graph(make_card(), metadata=False)
    onnx.helper.set_model_props(model, {"a": "1", CARD_KEY: ""})
    assert card_text(model.SerializeToString()) == ""


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\x72", "ends within a number"),
        (b"\x72\x05ab", "leaves the message"),
        (b"\x73", "wire type 3"),
        (b"\x00", "leaves the message|ends within"),
        (b"\xff" * 11, "more than ten bytes"),
    ],
)
def test_other_bytes_are_refused(content: bytes, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        card_text(content)


@given(st.binary(max_size=200))
def test_any_bytes_end_in_an_answer_or_a_value_error(content: bytes) -> None:
    with suppress(ValueError):
        card_text(content)


def test_damaged_graphs_end_in_an_answer_or_a_value_error(
    make_card: Callable[..., ModelCard], make_graph: Callable[..., Any]
) -> None:
    whole = make_graph(make_card()).SerializeToString()
    rng = random.Random(0)
    outcomes = set()
    for _ in range(500):
        damaged = bytearray(whole[: rng.randrange(len(whole))] if rng.random() < 0.5 else whole)
        for _ in range(rng.randrange(1, 4)):
            if damaged:
                damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        try:
            outcomes.add(type(card_text(bytes(damaged))))
        except ValueError:
            outcomes.add(ValueError)
    assert ValueError in outcomes
    assert str in outcomes
