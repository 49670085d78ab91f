"""The proof: what it measures, what it lets pass, and that another network does not pass."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from attentionvote.data.samples import Batch, collate
from attentionvote.evaluation import SceneResult
from attentionvote.export.parity import compare, measure_parity
from attentionvote.export.parity_record import Limits, Parity, table
from attentionvote.geometry.pose import rotation_about, transform
from attentionvote.model.neighborhoods import find_neighborhoods
from attentionvote.model.network import AttentionVote
from attentionvote.part import Part

LIMITS = Limits(0.1, 0.01, 0.1, 0.01, 0.01, 0.001, 0, 0.002, scenes=2)
Cloud = tuple[NDArray[np.float32], NDArray[np.float32]]


def poses(*shifts: float) -> NDArray[np.float64]:
    """Upright poses along x, metres."""
    return np.stack([transform(np.eye(3), [x, 0.0, 0.5]) for x in shifts]) if shifts else np.zeros((0, 4, 4))


def scene(found: NDArray[np.float64], scores: list[float]) -> SceneResult:
    truth = poses(0.0, 0.2, 0.4)
    return SceneResult(found, np.array(scores), truth, np.zeros(3))


def test_equal_answers_are_equal(part: Part) -> None:
    answers = [scene(poses(0.0, 0.2), [0.9, 0.8]), scene(poses(), [])]
    parity = compare(answers, answers, part, 0.5)
    assert (parity.scenes, parity.pairs, parity.unmatched) == (2, 2, 0)
    assert (parity.translation_mm, parity.rotation_degrees, parity.confidence) == (0.0, 0.0, 0.0)
    assert parity.violations(LIMITS) == []


def test_differences_are_in_millimetres_and_degrees(part: Part) -> None:
    moved = poses(0.0, 0.2)
    moved[1, 1, 3] += 0.00025
    moved[0, :3, :3] = rotation_about([1, 0, 0], np.radians(0.3))
    parity = compare([scene(poses(0.0, 0.2), [0.9, 0.8])], [scene(moved, [0.9, 0.78])], part, 0.5)
    assert parity.translation_mm == pytest.approx(0.25)
    assert parity.rotation_degrees == pytest.approx(0.3)
    assert parity.confidence == pytest.approx(0.02)
    assert parity.translation_p99_mm == pytest.approx(0.99 * 0.25)


def test_a_rotation_of_the_parts_symmetry_is_no_difference(part: Part) -> None:
    turned = poses(0.0) @ transform(part.symmetry.rotations()[-1], np.zeros(3))
    assert np.abs(turned - poses(0.0)).max() > 1
    parity = compare([scene(poses(0.0), [0.9])], [scene(turned, [0.9])], part, 0.5)
    assert parity.rotation_degrees < 1e-4


def test_a_detection_that_only_one_side_has_is_counted(part: Part) -> None:
    ours, theirs = scene(poses(0.0, 0.2, 0.4), [0.9, 0.8, 0.7]), scene(poses(0.0, 0.3), [0.9, 0.8])
    assert compare([ours], [theirs], part, 0.5).unmatched == 3
    assert compare([theirs], [ours], part, 0.5).unmatched == 3
    assert compare([ours], [scene(poses(), [])], part, 0.5).unmatched == 3


def test_a_partner_just_below_the_threshold_is_a_partner(part: Part) -> None:
    parity = compare([scene(poses(0.0), [0.501])], [scene(poses(0.0), [0.499])], part, 0.5)
    assert (parity.pairs, parity.unmatched) == (1, 0)
    both_below = compare([scene(poses(0.0), [0.49])], [scene(poses(0.0), [0.49])], part, 0.5)
    assert (both_below.pairs, both_below.unmatched) == (0, 0)


def test_one_jump_in_a_hundred_is_the_largest_difference_and_not_the_percentile(part: Part) -> None:
    places = np.arange(101) * 0.3
    jumped = np.full(101, 0.9)
    jumped[7] = 0.75
    parity = compare([scene(poses(*places), np.full(101, 0.9))], [scene(poses(*places), jumped)], part, 0.5)
    assert (parity.pairs, parity.unmatched) == (101, 0)
    assert parity.confidence == pytest.approx(0.15)
    assert parity.confidence_p99 == pytest.approx(0.0)
    jumped[8] = 0.75
    twice = compare([scene(poses(*places), np.full(101, 0.9))], [scene(poses(*places), jumped)], part, 0.5)
    assert twice.confidence_p99 > 0.1


def test_average_precision_is_that_of_all_confidences(part: Part) -> None:
    parity = compare([scene(poses(0.0, 0.2, 0.4), [0.9, 0.8, 0.1])], [scene(poses(0.0), [0.9])], part, 0.5)
    assert parity.ap["ap_10"][0] == pytest.approx(1.0)
    assert parity.ap["ap_10"][1] < 0.5
    assert any(v.startswith("ap_10 must agree within 0.002, got 1.0000 and 0.") for v in parity.violations(LIMITS))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"scenes": 1}, "scenes must be at least 2, got 1"),
        ({"pairs": 0}, "at least one detection must be compared, got none"),
        ({"unmatched": 1, "unmatched_scenes": (4,)}, "unmatched must be at most 0, got 1 (scene 4)"),
        ({"translation_mm": 0.11, "worst_scene": 3}, "translation_mm must be at most 0.1, got 0.11 (scene 3)"),
        ({"translation_p99_mm": 0.011}, "translation_p99_mm must be at most 0.01, got 0.011"),
        ({"rotation_degrees": 0.2}, "rotation_degrees must be at most 0.1, got 0.2"),
        ({"rotation_p99_degrees": 0.02}, "rotation_p99_degrees must be at most 0.01, got 0.02"),
        ({"confidence_p99": 0.002}, "confidence_p99 must be at most 0.001, got 0.002"),
        ({"confidence": float("nan")}, "confidence must be at most 0.01, got nan"),
        ({"ap": {"ap_5": (0.5, 0.4979)}}, "ap_5 must agree within 0.002, got 0.5000 and 0.4979"),
    ],
)
def test_every_broken_limit_has_its_sentence(change: dict, words: str) -> None:
    at_the_limit = Parity(2, 5, 0, 0.1, 0.01, 0.1, 0.01, 0.01, 0.001, {"ap_10": (0.9, 0.9019)})
    assert at_the_limit.violations(LIMITS) == []
    broken = replace(at_the_limit, **change).violations(LIMITS)
    assert len(broken) == 1
    assert broken[0].startswith(words)


def test_the_table_has_a_column_for_every_path() -> None:
    parity = Parity(
        32, 5, 0, 0.1, 0.01, 0.1, 0.01, 0.01, 0.001, dict.fromkeys(("ap_10", "ap_5", "ap_2"), (0.9, 0.8999))
    )
    lines = list(table({"CPU": parity, "CUDA": parity}, LIMITS))
    assert "CPU" in lines[0]
    assert "CUDA" in lines[0]
    assert [line.split()[-1] for line in lines[1:4]] == ["2", "1", "0"]
    assert "0.9000 | 0.8999" in lines[-1]
    assert len({len(line) for line in lines}) == 1


def batch(network: AttentionVote, cloud: Cloud) -> Batch:
    """A sample without truth: parity needs none but for the average precision."""
    points, normals = cloud
    nothing = torch.zeros(len(points), dtype=torch.long)
    sample = Batch(
        torch.from_numpy(points), torch.from_numpy(normals), nothing, find_neighborhoods(points, network.layout),
        torch.tensor([[0.0, 0.0, 0.5]]), torch.eye(3)[None], torch.ones(1), torch.zeros(1, dtype=torch.long),
    )  # fmt: skip
    return collate([sample])


def run_of(network: AttentionVote) -> Callable[..., dict]:
    """A network as if it were a graph."""

    def run(points: NDArray[np.float32], normals: NDArray[np.float32]) -> dict:
        with torch.no_grad():
            return {k: v.numpy() for k, v in network(*map(torch.from_numpy, (points, normals)))._asdict().items()}

    return run


def test_the_network_itself_passes_and_another_does_not(
    network: AttentionVote, make_network: Callable[[int], AttentionVote], make_cloud: Callable[..., Cloud], part: Part
) -> None:
    samples = [batch(network, make_cloud(seed)) for seed in range(3)]
    same = measure_parity(network, run_of(network), samples, part, 0.05, 0.1)
    assert same.pairs >= 6
    assert same.violations(LIMITS) == []
    other = measure_parity(network, run_of(make_network(1)), samples, part, 0.05, 0.1)
    assert other.unmatched > 0
    broken = make_network(0)
    with torch.no_grad():
        broken.refiners[-1].output.bias[:3] += 0.1  # moves every final centre by 0.01 D along each axis
    moved = measure_parity(network, run_of(broken), samples, part, 0.05, 0.1)
    assert moved.translation_mm == pytest.approx(1000 * 0.01 * part.diameter * 3**0.5, rel=0.1)
    assert any(v.startswith("translation_mm must be at most 0.1") for v in moved.violations(LIMITS))


def test_the_worst_scene_and_those_with_unmatched_poses_are_named(part: Part) -> None:
    fine, moved = scene(poses(0.0), [0.9]), poses(0.0)
    moved[0, 0, 3] += 0.0003
    answers = [fine, scene(moved, [0.9]), scene(poses(), []), fine]
    parity = compare([fine] * 4, answers, part, 0.5)
    assert (parity.worst_scene, parity.unmatched_scenes) == (1, (2,))


def test_an_answer_that_is_no_number_is_refused(
    network: AttentionVote, make_cloud: Callable[..., Cloud], part: Part
) -> None:
    def damaged(points: NDArray[np.float32], normals: NDArray[np.float32]) -> dict:
        outputs = run_of(network)(points, normals)
        outputs["confidence"] = np.full_like(outputs["confidence"], np.nan)
        return outputs

    with pytest.raises(ValueError, match="the graph's confidence must be finite, got NaN or inf in scene 0"):
        measure_parity(network, damaged, [batch(network, make_cloud(0))], part, 0.05, 0.1)


def test_a_record_is_read_as_it_was_written(part: Part) -> None:
    parity = compare([scene(poses(0.0, 0.2), [0.9, 0.8])], [scene(poses(0.001), [0.9])], part, 0.5)
    assert parity.unmatched == 1
    assert Parity.from_dict(json.loads(json.dumps(parity.as_dict()))) == parity
    assert Parity.from_dict(parity.as_dict() | {"translation_mm": 2e-05}).translation_mm == 2e-05


@pytest.mark.parametrize("change", [{"ap": None}, {"pairs": "many"}, {"extra": 1}, {"unmatched_scenes": 3}])
def test_another_record_is_refused(part: Part, change: dict[str, object]) -> None:
    parity = compare([scene(poses(0.0), [0.9])], [scene(poses(0.0), [0.9])], part, 0.5)
    with pytest.raises(ValueError, match="a record of parity must h"):
        Parity.from_dict(parity.as_dict() | change)
