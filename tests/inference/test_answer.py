"""Answers: the same rule as training's, most confident first, and plain data for JSON."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from attentionvote.contract import FRAME, ModelCard
from attentionvote.geometry.pose import random_quaternion, rotation_about, transform
from attentionvote.inference.answer import Abstention, Detection, Estimate, detections_from

MakeCard = Callable[..., ModelCard]
# Values at, just below and above the thresholds of the card below, and the marks of no peak and of merged proposals.
EDGES = st.sampled_from([0.0, 0.25, 0.49999997, 0.5, 0.50000006, 0.9, 1.5, 7.0])


def outputs(
    heat: list[float], confidence: list[float], seed: int = 0, classes: int = 1
) -> dict[str, NDArray[np.float32]]:
    """A graph's outputs with these heats and confidences and random poses."""
    rng = np.random.default_rng(seed)
    k = len(heat)
    made = {
        "vote_xyz": rng.normal(size=(1, 4, 3)),
        "center_seed": rng.normal(size=(1, k, 3)),
        "peak_heat": np.array([heat]),
        "center": rng.normal(size=(1, k, 3)),
        "quaternion": random_quaternion(rng, (1, k)),
        "class_logits": rng.normal(size=(1, k, classes)),
        "confidence": np.array([confidence]),
    }
    return {name: array.astype(np.float32) for name, array in made.items()}


@pytest.fixture(scope="module")
def scene_results(repository: Path) -> Callable[..., Any]:
    """Training's rule, loaded by its file: its package imports Lightning, which takes ten seconds."""
    path = repository / "src" / "attentionvote" / "training" / "detections.py"
    spec = importlib.util.spec_from_file_location("detections_of_training", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.scene_results


@given(
    st.lists(st.tuples(EDGES, EDGES), min_size=1, max_size=8),
    st.sampled_from([0.0, 0.5]),
    st.sampled_from([0.0, 0.5]),
    st.integers(0, 1000),
)
def test_what_is_detected_is_what_training_measured(
    make_card: MakeCard,
    scene_results: Callable[..., Any],
    pairs: list[tuple[float, float]],
    peak: float,
    least: float,
    seed: int,
) -> None:
    import torch

    from attentionvote.data.samples import Batch
    from attentionvote.model.predictions import Predictions

    card = make_card(peak_threshold=peak, confidence_threshold=least)
    raw = outputs([heat for heat, _ in pairs], [confidence for _, confidence in pairs], seed)
    predictions = Predictions(**{name: torch.from_numpy(array) for name, array in raw.items()})
    none = torch.zeros(1, 1, 3)
    batch = Batch(none, none, none, None, none, torch.eye(3)[None, None], torch.zeros(1, 1), torch.zeros(1, 1))  # type: ignore[arg-type]
    expected = scene_results(predictions, batch, peak, least)[0]
    found, unsound = detections_from(raw, card)
    assert unsound == 0
    order = np.argsort(-expected.scores, kind="stable")
    np.testing.assert_array_equal([d.confidence for d in found], expected.scores[order])
    np.testing.assert_allclose(
        np.array([d.camera_from_part for d in found]).reshape(-1, 4, 4), expected.poses[order], atol=1e-12
    )


def test_the_class_with_the_highest_score_is_named(make_card: MakeCard) -> None:
    raw = outputs([1, 1], [0.9, 0.8], classes=3)
    raw["class_logits"] = np.float32([[[0, 1, 0], [2, 1, 0]]])
    found, _ = detections_from(raw, make_card(classes=("a", "b", "c")))
    assert [d.part for d in found] == ["b", "a"]


@pytest.mark.parametrize("name", ["center", "quaternion"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_pose_that_is_none_never_reaches_the_robot(make_card: MakeCard, name: str, value: float) -> None:
    raw = outputs([1, 1, 1, 0], [0.9, 0.8, 0.7, 0.99])
    raw[name][0, 1, 0] = raw[name][0, 3, 0] = value
    found, unsound = detections_from(raw, make_card())
    assert [round(d.confidence, 3) for d in found] == [0.9, 0.7]
    assert unsound == 1  # the fourth is no peak, so nobody misses it


def test_nan_confidence_and_zero_quaternions_are_left_out(make_card: MakeCard) -> None:
    raw = outputs([1, np.nan, 1, np.inf], [np.nan, 0.9, 0.9, 0.9])
    raw["quaternion"][0, 2] = 0
    assert detections_from(raw, make_card()) == ((), 2)


DETECTION = Detection(transform(rotation_about([0, 0, 1], np.pi / 2), [0.1, 0.2, 0.8]), 0.9, "bracket", 5.0)
FACTS: dict[str, Any] = {
    "part": "bracket", "model": "abc", "points_given": 100, "points_measured": 95, "points_used": 90,
}  # fmt: skip


def test_an_estimate_is_plain_data() -> None:
    answer = Estimate(detections=(DETECTION,), **FACTS, seconds={"total": 0.5}, warnings=("a warning",))
    said = json.loads(json.dumps(answer.to_dict(), allow_nan=False))
    pose = said.pop("poses")[0]
    assert said == {
        "answer": "estimate",
        "frame": FRAME,
        "units": "m",
        "part": "bracket",
        "model": "abc",
        "points_given": 100,
        "points_measured": 95,
        "poses_withheld": 0,
        "points_used": 90,
        "seconds": {"total": 0.5},
        "warnings": ["a warning"],
    }
    np.testing.assert_allclose(pose.pop("camera_from_part"), DETECTION.camera_from_part)
    np.testing.assert_allclose(pose.pop("quaternion"), [0.5**0.5, 0, 0, 0.5**0.5], atol=1e-12)
    assert pose == {"position": [0.1, 0.2, 0.8], "confidence": 0.9, "heat": 5.0, "part": "bracket"}


def test_an_abstention_has_the_same_fields_and_no_poses() -> None:
    estimate = Estimate(detections=(DETECTION,), **FACTS)
    abstention = Abstention(reason="too_few_points", message="why", **FACTS)
    said = abstention.to_dict()
    assert set(said) == set(estimate.to_dict()) | {"reason", "message"}
    assert (said["answer"], said["reason"], said["message"], said["poses"]) == (
        "abstention",
        "too_few_points",
        "why",
        [],
    )
    json.dumps(replace(abstention, seconds={"total": 0.1}).to_dict(), allow_nan=False)
