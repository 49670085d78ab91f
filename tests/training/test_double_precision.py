"""In double precision nothing stays single: losses, gradients and predictions are those of float32, to its rounding."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from attentionvote.data.samples import Batch
from attentionvote.geometry.pose import quaternion_from_matrix
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.model.neighborhoods import Neighborhoods, find_neighborhoods
from attentionvote.model.network import AttentionVote
from attentionvote.part import Part, PartSet
from attentionvote.training.losses import AttentionVoteLoss
from attentionvote.training.module import PoseTraining
from attentionvote.training.part_poses import PartPoses
from attentionvote.training.pictures import picture_inputs
from attentionvote.training.pose_loss import RotationLoss, SymmetricPose
from attentionvote.training.schedule import Schedule
from attentionvote.training.settings import LossSettings
from attentionvote.training.step import batch_loss

WEIGHTS = dict.fromkeys(AttentionVoteLoss.TERMS, 1.0)
KINDS: tuple[RotationLoss, ...] = ("metric", "slerp", "minra", "nlerp")


@pytest.fixture
def two_parts(make_box: Callable[..., Part]) -> PartSet:
    """Of two sizes that float32 cannot hold, one with a group and one with an axis."""
    small, large = make_box(Symmetry("dihedral", order=3)), make_box(Symmetry("revolution", (1.0, 2.0, 2.0)))
    return PartSet("two", (replace(small, name="small"), replace(large, name="large", diameter=0.13)))


def rotations(make_rotations: Callable, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Predicted quaternions and rotations, true rotations; both hold exactly what float32 can hold."""
    predicted, true = (torch.from_numpy(make_rotations(seed + i, 12)).float().double() for i in (0, 1))
    quaternion = torch.from_numpy(quaternion_from_matrix(predicted.numpy())).float().double()
    return quaternion, predicted, true


@pytest.mark.parametrize("kind", KINDS)
def test_pose_losses_follow_the_precision_of_the_predictions(
    symmetric_part: Part, make_rotations: Callable, kind: RotationLoss
) -> None:
    pose, given = SymmetricPose.of(symmetric_part, 0.1), rotations(make_rotations, 5)
    wide, narrow = pose.rotation_loss(kind, *given), pose.rotation_loss(kind, *(t.float() for t in given))
    assert (wide.dtype, narrow.dtype) == (torch.float64, torch.float32)
    torch.testing.assert_close(narrow.double(), wide, rtol=2e-6, atol=2e-6)
    assert (narrow.double() != wide).any()  # else the wide one was computed narrow


@pytest.mark.parametrize("kind", KINDS)
def test_so_do_those_of_several_parts(two_parts: PartSet, make_rotations: Callable, kind: RotationLoss) -> None:
    poses, given, part = PartPoses.of(two_parts, 0.1), rotations(make_rotations, 7), torch.arange(12) % 2
    wide, narrow = poses.rotation_loss(kind, part, *given), poses.rotation_loss(kind, part, *(t.float() for t in given))
    assert (wide.dtype, narrow.dtype) == (torch.float64, torch.float32)
    torch.testing.assert_close(narrow.double(), wide, rtol=2e-6, atol=2e-6)
    for row in range(12):  # to double precision what each part computes alone
        own = SymmetricPose.of(two_parts.parts[row % 2], 0.1).rotation_loss(kind, *(t[row : row + 1] for t in given))
        torch.testing.assert_close(wide[row : row + 1], own, rtol=1e-12, atol=1e-12)
    assert poses.diameter(part, torch.float64).tolist() == [0.1, 0.13] * 6  # type: ignore[union-attr]


def terms_and_gradient(
    model: AttentionVote, loss: AttentionVoteLoss, batch: Batch
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Terms of a batch, and the gradient of every weight that has one."""
    model.zero_grad()
    terms = batch_loss(model, loss, batch, ramp=1.0, least_heat=0.0)
    loss.total(terms).backward()
    return {k: v.detach() for k, v in terms.items()}, {
        name: p.grad for name, p in model.named_parameters() if p.grad is not None
    }


@pytest.mark.parametrize("several", [False, True], ids=["one part", "two parts"])
def test_a_whole_batch_costs_the_same_in_both_precisions(
    make_network: Callable[..., AttentionVote], make_scenes: Callable[..., Batch], make_box: Callable[..., Part],
    two_parts: PartSet, several: bool,
) -> None:  # fmt: skip
    batch, part = make_scenes(3, 1, 2, 1), two_parts if several else make_box(Symmetry("cyclic", order=2))
    if several:
        batch = batch._replace(part=torch.arange(batch.part.numel()).view(batch.part.shape) % 2)
    loss = AttentionVoteLoss(part, WEIGHTS, LossSettings(assignment=1.0))
    model = make_network(classes=2 if several else 1).train()
    narrow, narrow_gradient = terms_and_gradient(model, loss, batch)
    wide, wide_gradient = terms_and_gradient(model.double(), loss, batch.to("cpu", torch.float64))
    assert set(wide) == set(narrow) == set(AttentionVoteLoss.TERMS) - (set() if several else {"semantic"})
    for name, value in wide.items():
        assert (value.dtype, narrow[name].dtype) == (torch.float64, torch.float32), name
        assert float(narrow[name]) == pytest.approx(float(value), rel=1e-5), name
        assert float(narrow[name]) != float(value), name
    flat = [torch.cat([g[name].flatten().double() for name in wide_gradient]) for g in (narrow_gradient, wide_gradient)]
    assert float((flat[0] - flat[1]).norm() / flat[1].norm()) < 1e-3


def test_a_double_module_takes_what_a_loader_gives(
    make_network: Callable[..., AttentionVote], make_scenes: Callable[..., Batch], make_box: Callable[..., Part]
) -> None:
    """Validation, test and pictures: none of them goes through Lightning's conversion of the batch alone."""
    part, batch = make_box(), make_scenes(3, 1)
    module = PoseTraining(make_network(), AttentionVoteLoss(part, WEIGHTS, LossSettings()), part, Schedule())
    module.model.eval()
    narrow = module.predict(batch)
    wide = module.double().predict(batch)
    assert {value.dtype for value in wide} == {torch.float64}
    for name, value in wide._asdict().items():
        torch.testing.assert_close(getattr(narrow, name).double(), value, rtol=1e-3, atol=1e-4, msg=name)
    assert len(module.examine(batch)) == 2
    assert [len(inputs["points"]) for inputs in picture_inputs(module, batch, 0.5)] == [160, 160]


def test_neighbours_found_by_the_network_follow_its_points(make_network: Callable[..., AttentionVote]) -> None:
    model = make_network().double().eval()
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.1, -0.1, 0.5], [0.1, 0.1, 0.7], (1, 160, 3))
    normals = torch.from_numpy(rng.normal(size=(1, 160, 3)))
    given = find_neighborhoods(points[0].astype(np.float32), model.layout)
    answer = model(torch.from_numpy(points), normals)
    assert {value.dtype for value in answer} == {torch.float64}
    one = Neighborhoods.stack([given]).to("cpu", torch.float64)
    for found, expected in zip(answer, model(torch.from_numpy(points), normals, one), strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=0)
