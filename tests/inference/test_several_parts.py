"""A model of several parts in a cell: its card, the names in its answers, the self-test of every part by itself."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from attentionvote.contract import ModelCard, PartCard
from attentionvote.geometry.pose import matrix_from_quaternion, quaternion_from_matrix, rotation_about
from attentionvote.inference import Bundle, BundleError, Estimate, PoseEstimator, load_bundle, self_test

MakeBundle = Callable[..., Path]
HALF = 0.5**0.5
QUATERNIONS = np.array([(1.0, 0.0, 0.0, 0.0), (HALF, 0.0, 0.0, HALF), (0.5, 0.5, 0.5, 0.5), (0.0, 1.0, 0.0, 0.0)])
BOX = ((-0.05, -0.02, -0.01), (0.05, 0.02, 0.01))
BOLT = PartCard("bolt", "a bolt", 0.09, "1" * 64, {"kind": "revolution", "axis": [0.0, 0.0, 1.0], "flip": False}, BOX)
PLATE = PartCard("plate", "a plate", 0.1, "2" * 64, {"kind": "none"}, BOX)
TWO: dict[str, Any] = {"classes": ("bolt", "plate"), "parts": (BOLT, PLATE), "part": {"name": "bin"}}
NAMED = (1, 0, 0, 1)  # the second proposal, the most confident one, is a bolt; the first is a plate


@pytest.fixture
def bundle(make_bundle: MakeBundle, trusted_key: Path) -> Bundle:
    return load_bundle(make_bundle(card=TWO, graph={"named": NAMED}), trusted_key)


@pytest.fixture
def problems(bundle: Bundle, make_graph: Callable[..., Any]) -> Callable[..., list[str]]:
    """What the self-test says of a graph with other answers."""

    def tried(**graph: Any) -> list[str]:
        model = make_graph(bundle.card, **({"named": NAMED} | graph)).SerializeToString()
        with PoseEstimator(replace(bundle, model=model)) as estimator:
            return self_test(estimator, bundle)

    return tried


def turned(which: int) -> NDArray[np.float64]:
    """The tiny graph's quaternions, one proposal turned by 40 degrees about its own z axis."""
    rotations = matrix_from_quaternion(QUATERNIONS)
    rotations[which] = rotations[which] @ rotation_about([0, 0, 1], np.radians(40))
    return quaternion_from_matrix(rotations)


def test_every_answer_says_what_it_found(bundle: Bundle, make_cloud: Callable[..., NDArray]) -> None:
    with PoseEstimator(bundle) as estimator:
        answer = estimator.estimate(make_cloud())
    assert isinstance(answer, Estimate)
    assert answer.part == "bin"
    assert [d.part for d in answer.detections] == ["bolt", "plate"]
    assert [pose["part"] for pose in answer.to_dict()["poses"]] == ["bolt", "plate"]


def test_the_self_test_knows_every_part_s_own_symmetry(problems: Callable[..., list[str]]) -> None:
    assert problems() == []
    assert problems(quaternions=turned(1)) == [], "a bolt turned about its axis is the same bolt"
    told = problems(quaternions=turned(0))
    assert len(told) == 2  # the plate is not: the expected pose is missing, another one is there
    assert "off by 0.00 mm and 40.00 degrees" in told[0]


def test_a_pose_under_another_name_does_not_pass(problems: Callable[..., list[str]]) -> None:
    told = problems(named=(1, 1, 0, 1))
    assert any("must give pose 0 with confidence 0.95 again, but gave no pose under its name" in s for s in told)
    assert any("that was not there when the bundle was made" in s for s in told)


def test_golden_clouds_need_the_names_of_their_poses(make_bundle: MakeBundle, trusted_key: Path) -> None:
    def forget(folder: Path) -> None:
        path = folder / "golden" / "cloud_0.npz"
        with np.load(path) as stored:
            arrays = {name: stored[name] for name in stored.files}
        np.savez(path, **arrays | {"part_ids": np.zeros(1)})

    bundle = load_bundle(make_bundle(card=TWO, graph={"named": NAMED}, change=forget), trusted_key)
    with pytest.raises(BundleError, match=r"of several parts also part_ids \(n,\) int64"):
        bundle.golden()


def test_a_card_of_several_parts_comes_back_from_its_text(make_card: Callable[..., ModelCard]) -> None:
    card = make_card(**TWO)
    assert ModelCard.from_json(card.to_json()) == card
    assert card.each_part == (BOLT, PLATE)
    assert dict(card.outputs)["class_logits"] == (1, 4, 2)


def test_a_card_of_one_part_says_nothing_of_parts_as_ever(make_card: Callable[..., ModelCard]) -> None:
    """Older cells read it, and cards of before are read: the version of the contract stays."""
    card = make_card()
    assert "parts" not in json.loads(card.to_json())
    assert ModelCard.from_json(card.to_json()) == card
    assert card.each_part == (card.part,)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"classes": ("plate", "bolt")}, "card parts must be the classes plate, bolt, two or more, got bolt, plate"),
        ({"classes": ("bolt",), "parts": (BOLT,)}, "card parts must be the classes bolt, two or more, got bolt"),
    ],
)
def test_parts_that_are_not_the_classes_are_refused(
    make_card: Callable[..., ModelCard], changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        make_card(**(TWO | changes))


def test_texts_with_impossible_parts_are_one_sentence(make_card: Callable[..., ModelCard]) -> None:
    content = json.loads(make_card(**TWO).to_json())
    for parts, message in (
        (3, "card parts must be a list of parts, got 3"),
        ([{"name": "bolt"}], "card parts must have the fields name, title"),
        ([content["parts"][0], 5], "card parts must have the fields name, title"),
    ):
        with pytest.raises(ValueError, match=message):
            ModelCard.from_json(json.dumps(content | {"parts": parts}))
