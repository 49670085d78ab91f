"""Losses of a bin with several parts: a mixed batch costs what its parts cost one by one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from attentionvote.data.samples import Batch, collate
from attentionvote.geometry.pose import quaternion_from_matrix
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.model.predictions import Poses, Votes
from attentionvote.model.proposals import Peaks
from attentionvote.part import Part, PartSet
from attentionvote.training.losses import Assignment, AttentionVoteLoss
from attentionvote.training.part_poses import PartPoses
from attentionvote.training.pose_loss import RotationLoss, SymmetricPose
from attentionvote.training.settings import LossSettings
from attentionvote.training.step import batch_loss

WEIGHTS = dict.fromkeys(AttentionVoteLoss.TERMS, 1.0)
KINDS: tuple[RotationLoss, ...] = ("metric", "slerp", "minra", "nlerp")


@pytest.fixture(scope="module")
def bin_of_three(make_box: Callable[..., Part]) -> PartSet:
    """Parts of three sizes with groups of 1, 4 and infinitely many rotations."""
    plain, turning = make_box(), make_box(Symmetry("revolution", (1.0, 2.0, 2.0), flip=True))
    group = make_box(Symmetry("dihedral", order=2))
    sizes = {"plain": (plain, 1.0), "group": (group, 0.8), "turning": (turning, 1.3)}
    parts = [
        replace(part, name=name, vertices=part.vertices * size, diameter=part.diameter * size)
        for name, (part, size) in sizes.items()
    ]
    return PartSet("three", tuple(parts))


@pytest.fixture(scope="module")
def mixed(make_sample: Callable[..., Batch]) -> Batch:
    """Four scenes of three instances, the last of two, of all parts."""
    batch = collate([make_sample(20 + i, n) for i, n in enumerate((3, 3, 3, 2))])
    return batch._replace(part=torch.tensor([[0, 1, 2], [2, 2, 0], [1, 1, 1], [2, 1, 0]]))


@pytest.fixture(scope="module")
def rows() -> tuple[Assignment, torch.Tensor]:
    """Two proposals on every instance, some of them not positive; and the part of each."""
    sample = torch.arange(4).repeat_interleave(4)
    instance = torch.tensor([0, 1, 2, 2, 0, 1, 2, 0, 0, 1, 2, 1, 0, 1, 0, 1])
    return Assignment(sample, instance, torch.arange(16) % 5 != 3), instance


def answers(count: int, seed: int, batch: Batch, assigned: Assignment, make_rotations: Callable) -> Poses:
    """Poses near and far from the truth, with logits of three classes."""
    rng = np.random.default_rng(seed)
    center = batch.center[assigned.sample, assigned.instance].numpy() + rng.normal(0, 0.003, (count, 3))
    rotation = batch.rotation[assigned.sample, assigned.instance].double().numpy()
    rotation[::2] = make_rotations(seed, count)[::2]
    numbers = (center, rotation, quaternion_from_matrix(rotation), rng.normal(size=(count, 3)), rng.normal(size=count),
               np.zeros((count, 2)))  # fmt: skip
    return Poses(*(torch.from_numpy(np.asarray(x)).float() for x in numbers))


@given(seed=st.integers(0, 10_000), kind=st.sampled_from(KINDS), isotropic=st.sampled_from([0.0, 0.1]))
@settings(max_examples=25)
def test_every_row_is_judged_by_its_own_part(
    bin_of_three: PartSet, make_rotations: Callable, seed: int, kind: RotationLoss, isotropic: float
) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(0, 12))
    part = torch.from_numpy(rng.integers(0, 3, count))
    predicted, true = (torch.from_numpy(make_rotations(seed + i, count)).float() for i in (0, 1))
    quaternion = torch.from_numpy(quaternion_from_matrix(predicted.double().numpy())).float()
    center, place = (torch.from_numpy(rng.normal(0, 0.01, (count, 3))).float() for _ in range(2))
    predicted.requires_grad_()
    mixed = PartPoses.of(bin_of_three, isotropic)
    loss = mixed.rotation_loss(kind, part, quaternion, predicted, true)
    distance = mixed.distance(part, center, predicted, place, true)
    assert loss.shape == distance.shape == (count,)
    for row in range(count):
        own, one = SymmetricPose.of(bin_of_three.parts[int(part[row])], isotropic), slice(row, row + 1)
        expected = own.rotation_loss(kind, quaternion[one], predicted[one], true[one])
        torch.testing.assert_close(loss[one], expected, rtol=1e-4, atol=1e-5)
        expected = own.distance(center[one], predicted[one], place[one], true[one])
        torch.testing.assert_close(distance[one], expected, rtol=1e-4, atol=1e-7)
    if count:
        loss.sum().backward()
        assert predicted.grad is None or predicted.grad.isfinite().all()


def test_one_part_is_not_asked_for_its_number(make_box: Callable[..., Part], make_rotations: Callable) -> None:
    part, turned = make_box(Symmetry("cyclic", order=2)), torch.from_numpy(make_rotations(0, 8)).float()
    alone, anything = PartPoses.of(part, 0.1), torch.full((4,), 99)
    torch.testing.assert_close(
        alone.squared_turn(anything, turned[:4], turned[4:]),
        SymmetricPose.of(part, 0.1).squared_turn(turned[:4], turned[4:]), rtol=0, atol=0,
    )  # fmt: skip
    assert alone.diameter(anything, torch.float32) == 0.1


def test_a_mixed_batch_s_votes_cost_the_mean_over_its_parts(
    bin_of_three: PartSet, mixed: Batch, make_rotations: Callable
) -> None:
    rng = np.random.default_rng(0)
    index = torch.from_numpy(rng.integers(0, 160, (4, 50)))
    xyz = torch.from_numpy(rng.normal([0, 0, 0.5], 0.05, (4, 50, 3))).float()
    votes = Votes(index, xyz, torch.zeros(4, 50, 2), torch.from_numpy(make_rotations(3, 200)).float().view(4, 50, 3, 3))
    terms = AttentionVoteLoss(bin_of_three, WEIGHTS, LossSettings()).vote_terms(votes, mixed)
    owner = torch.take_along_dim(mixed.instance, index, dim=1)
    kinds = torch.where(owner >= 0, mixed.part[torch.arange(4)[:, None], owner.clamp(min=0)], -1)
    expected = dict.fromkeys(terms, 0.0)
    for k, part in enumerate(bin_of_three.parts):
        own = mixed.part[torch.arange(4)[:, None], mixed.instance.clamp(min=0)] == k
        alone = mixed._replace(instance=torch.where(own, mixed.instance, -1), part=torch.zeros_like(mixed.part))
        share = (kinds == k).sum() / (kinds >= 0).sum()
        assert share > 0.1
        for name, value in AttentionVoteLoss(part, WEIGHTS, LossSettings()).vote_terms(votes, alone).items():
            expected[name] += float(share * value)
    assert expected.keys() == {"vote", "vote_rotation"}
    for name, value in expected.items():
        assert float(terms[name]) == pytest.approx(value, rel=1e-4), name


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("confidence", ["quality", "exponential"])
def test_a_mixed_batch_s_proposals_cost_the_mean_over_their_parts(
    bin_of_three: PartSet, mixed: Batch, rows: tuple[Assignment, torch.Tensor], make_rotations: Callable,
    kind: RotationLoss, confidence: str,
) -> None:  # fmt: skip
    assigned, choices = rows[0], LossSettings(kind, confidence=confidence)  # type: ignore[arg-type]
    poses = answers(16, 1, mixed, assigned, make_rotations)
    loss = AttentionVoteLoss(bin_of_three, WEIGHTS, choices)
    terms = loss.proposal_terms(poses, assigned, mixed) | {"refined": loss.refined_term(poses, assigned, mixed)}
    expected = dict.fromkeys(terms, 0.0)
    kinds = mixed.part[assigned.sample, assigned.instance]
    for k, part in enumerate(bin_of_three.parts):
        own = assigned._replace(positive=assigned.positive & (kinds == k))
        share = own.positive.sum() / assigned.positive.sum()
        assert share > 0.1
        single = AttentionVoteLoss(part, WEIGHTS, choices)
        alone = single.proposal_terms(poses, own, mixed) | {"refined": single.refined_term(poses, own, mixed)}
        for name, value in alone.items():
            expected[name] += float(share * value)
    assert {"center", "rotation", "semantic", "refined"} <= terms.keys()
    for name, value in expected.items():
        assert float(terms[name]) == pytest.approx(value, rel=1e-4), name


def test_the_semantic_term_is_the_cross_entropy_of_the_parts(
    bin_of_three: PartSet, mixed: Batch, rows: tuple[Assignment, torch.Tensor], make_rotations: Callable
) -> None:
    assigned = rows[0]
    poses = answers(16, 2, mixed, assigned, make_rotations)
    terms = AttentionVoteLoss(bin_of_three, WEIGHTS, LossSettings()).proposal_terms(poses, assigned, mixed)
    logits, truth = poses.class_logits.double().numpy(), mixed.part[assigned.sample, assigned.instance].numpy()
    entropy = np.log(np.exp(logits).sum(1)) - logits[np.arange(16), truth]
    assert float(terms["semantic"]) == pytest.approx(entropy[assigned.positive.numpy()].mean(), rel=1e-5)


def test_a_proposal_reaches_as_far_as_its_instance_s_part_is_large(bin_of_three: PartSet, mixed: Batch) -> None:
    loss = AttentionVoteLoss(bin_of_three, WEIGHTS, LossSettings())
    limits = torch.tensor([0.2 * part.diameter for part in bin_of_three.parts])[mixed.part]
    for share, expected in ((0.99, True), (1.01, False)):
        seeds = mixed.center + torch.stack([torch.zeros_like(limits), share * limits, torch.zeros_like(limits)], -1)
        assigned = loss.assign(Peaks(seeds, torch.ones(4, 3), torch.ones(4, 3)), mixed, torch.arange(12)[:11])
        np.testing.assert_array_equal(assigned.instance, torch.arange(11) % 3)
        assert (assigned.positive == expected).all()


def test_a_pose_under_another_name_is_worth_nothing(
    bin_of_three: PartSet, mixed: Batch, rows: tuple[Assignment, torch.Tensor], make_rotations: Callable
) -> None:
    assigned = rows[0]._replace(positive=torch.ones(16, dtype=torch.bool))
    poses = answers(16, 4, mixed, assigned, make_rotations)
    truth = mixed.part[assigned.sample, assigned.instance]
    turn = bin_of_three.parts[1].symmetry.rotations()[1]
    rotation = mixed.rotation[assigned.sample, assigned.instance].clone()
    rotation[truth == 1] = rotation[truth == 1] @ torch.from_numpy(turn).float()  # as good, for this part alone
    center = mixed.center[assigned.sample, assigned.instance]
    named = torch.nn.functional.one_hot(truth, 3).float()
    exact = poses._replace(center=center, rotation=rotation, class_logits=named)
    loss = AttentionVoteLoss(bin_of_three, WEIGHTS, LossSettings(one_per_instance=False))
    np.testing.assert_allclose(loss.quality(exact, assigned, mixed), 1.0)
    misnamed = exact._replace(class_logits=named.roll(1, dims=1))
    np.testing.assert_allclose(loss.quality(misnamed, assigned, mixed), 0.0)
    # 3 % of a diameter off: of the three thresholds two are met, whatever the part's size.
    diameters = torch.tensor([part.diameter for part in bin_of_three.parts])[truth]
    off = exact._replace(center=center + 0.03 * diameters[:, None] * torch.tensor([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(loss.quality(off, assigned, mixed), 2 / 3, rtol=1e-6)


def test_a_network_of_several_classes_trains_on_a_mixed_batch(
    bin_of_three: PartSet, mixed: Batch, make_network: Callable
) -> None:
    model = make_network(classes=3, diameter=bin_of_three.diameter, box=bin_of_three.box.tolist()).train()
    loss = AttentionVoteLoss(bin_of_three, WEIGHTS, LossSettings(assignment=1.0))
    terms = batch_loss(model, loss, mixed, ramp=1.0, least_heat=0.0)
    assert terms.keys() == set(AttentionVoteLoss.TERMS)
    loss.total(terms).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())
    head = model.output.weight.grad[-1 - 3 : -1]
    assert (head.abs().sum(1) > 0).all(), "every class learns"
