"""Every term of the loss against numpy, the assignment, and batches in which something is missing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from attentionvote.data.samples import Batch, collate
from attentionvote.evaluation import PoseMetric
from attentionvote.geometry.pose import canonical_quaternion, quaternion_from_matrix, rotation_about, transform
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.model.neighborhoods import find_neighborhoods
from attentionvote.model.network import AttentionVote
from attentionvote.model.predictions import Poses, Votes
from attentionvote.model.proposals import Peaks
from attentionvote.part import Part, PartSet
from attentionvote.training.losses import Assignment, AttentionVoteLoss, masked_mean
from attentionvote.training.settings import LossSettings, check_isotropic
from attentionvote.training.step import batch_loss

WEIGHTS = dict.fromkeys(AttentionVoteLoss.TERMS, 1.0)
PAPER = {"vote": 1.0, "center": 1.0, "rotation": 2.5, "semantic": 0.1, "confidence": 1.0}
PAPER_SETTINGS = LossSettings(rotation="slerp", isotropic=0.0, least_visible=0.0, confidence="exponential")


def votes_at(xyz: Tensor, seed_index: Tensor, rotation: Tensor | None = None) -> Votes:
    return Votes(seed_index, xyz, torch.zeros(*xyz.shape[:2], 4), rotation)


def poses_of(
    rotation: np.ndarray, center: np.ndarray, score: np.ndarray | None = None, logits: np.ndarray | None = None
) -> Poses:
    rows = len(rotation)
    numbers = (
        center, rotation, quaternion_from_matrix(rotation), np.zeros((rows, 1)) if logits is None else logits,
        np.zeros(rows) if score is None else score, np.zeros((rows, 2)),
    )  # fmt: skip
    return Poses(*(torch.from_numpy(np.asarray(x)).float() for x in numbers))


def near_truth(batch: Batch, assigned: Assignment, seed: int, off: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and centres near those of the assigned instances."""
    rng = np.random.default_rng(seed)
    at = assigned.sample, assigned.instance
    rotation = batch.rotation[at].double().numpy()
    turned = np.stack([r @ rotation_about(rng.normal(size=3), rng.uniform(0, 0.5)) for r in rotation])
    return turned, batch.center[at].double().numpy() + rng.normal(0, off, (len(rotation), 3))


@pytest.fixture
def batch(make_scenes: Callable) -> Batch:
    """Three instances, none, one."""
    return make_scenes(3, 0, 1)


@pytest.fixture
def assigned() -> Assignment:
    sample, instance = torch.tensor([0, 0, 0, 2, 2, 0]), torch.tensor([0, 1, 1, 0, 0, 2])
    return Assignment(sample, instance, torch.tensor([True, True, True, True, False, True]))


def test_vote_loss_is_equation_1_over_the_seeds_on_an_instance(make_box: Callable, batch: Batch) -> None:
    rng = np.random.default_rng(0)
    index = torch.from_numpy(rng.integers(0, 160, (3, 30)))
    xyz = torch.from_numpy(rng.normal([0, 0, 0.5], 0.05, (3, 30, 3))).float()
    errors = [
        np.linalg.norm(xyz[b, m].numpy() - batch.center[b, i].numpy())
        for b in range(3)
        for m in range(30)
        if (i := int(batch.instance[b, index[b, m]])) >= 0
    ]
    assert 30 < len(errors) < 60  # two samples with instances, a few seeds on the background
    terms = AttentionVoteLoss(make_box(), WEIGHTS, LossSettings()).vote_terms(votes_at(xyz, index), batch)
    assert terms.keys() == {"vote"}
    np.testing.assert_allclose(terms["vote"], np.mean(errors) / 0.01, rtol=1e-5)


def test_true_votes_of_a_symmetric_part_cost_nothing(make_box: Callable, batch: Batch) -> None:
    part: Part = make_box(Symmetry("cyclic", order=2))
    index = torch.arange(160).expand(3, -1)
    instance = batch.instance.clamp(min=0)
    rows = torch.arange(3)[:, None]
    half_turn = torch.from_numpy(part.symmetry.rotations()[1]).float()
    votes = votes_at(batch.center[rows, instance], index, batch.rotation[rows, instance] @ half_turn)
    terms = AttentionVoteLoss(part, WEIGHTS, LossSettings()).vote_terms(votes, batch)
    assert terms["vote"] < 2e-4  # the micrometre that keeps the gradient bounded, in tenths of the diameter
    assert terms["vote_rotation"] < 1e-4
    unlike = votes._replace(rotation=batch.rotation[rows, instance].flip(-1))
    assert AttentionVoteLoss(part, WEIGHTS, LossSettings()).vote_terms(unlike, batch)["vote_rotation"] > 0.1


def test_proposals_belong_to_the_nearest_visible_instance_within_the_threshold(
    make_box: Callable, batch: Batch
) -> None:
    batch = batch._replace(visible=torch.tensor([[1.0, 0.01, 0.5], [0.0, 0.0, 0.0], [0.2, 0.0, 0.0]]))
    rng = np.random.default_rng(1)
    near = batch.center[:, torch.arange(8) % 3].numpy()
    seeds = torch.from_numpy(rng.normal(near, 0.011)).float()
    seeds[1, 0] = 0.0  # where padding lies
    rows = torch.arange(24)[::2]
    for least in (0.05, 0.0):
        loss = AttentionVoteLoss(make_box(), WEIGHTS, LossSettings(least_visible=least))
        result = loss.assign(Peaks(seeds, torch.ones(3, 8), torch.ones(3, 8)), batch, rows)
        positives = 0
        for k, row in enumerate(rows.tolist()):
            b, seed = row // 8, seeds[row // 8, row % 8]
            able = [i for i in range(3) if batch.visible[b, i] > 0 and batch.visible[b, i] >= least]
            distances = {i: float((seed - batch.center[b, i]).norm()) for i in able}
            nearest = min(distances, key=lambda i: distances[i]) if able else None
            wanted = nearest is not None and distances[nearest] < 0.2 * 0.1
            assert int(result.sample[k]) == b
            assert bool(result.positive[k]) == wanted
            positives += wanted
            if nearest is not None:
                assert int(result.instance[k]) == nearest
        assert 2 <= positives < len(rows)


@pytest.mark.parametrize("detach", [True, False])
def test_proposal_terms_are_equations_9_and_10(
    make_box: Callable, batch: Batch, assigned: Assignment, detach: bool
) -> None:
    rng = np.random.default_rng(2)
    rotation, center = near_truth(batch, assigned, 2)
    score, logits = rng.normal(size=6), rng.normal(size=(6, 2))
    settings = LossSettings("slerp", 0.0, least_visible=0.0, confidence="exponential", detach_confidence=detach)
    poses = poses_of(rotation, center, score, logits)
    for tensor in (poses.center, poses.score):
        tensor.requires_grad_()
    terms = AttentionVoteLoss(make_box(), PAPER, settings).proposal_terms(poses, assigned, batch)

    positive = assigned.positive.numpy()
    at = assigned.sample, assigned.instance
    apart = np.linalg.norm(center - batch.center[at].numpy(), axis=1) / 0.01
    true = canonical_quaternion(quaternion_from_matrix(batch.rotation[at].double().numpy()))
    turn = 2 * np.arccos((quaternion_from_matrix(rotation) * true).sum(1))
    semantic = np.log(np.exp(logits).sum(1)) - logits[:, 0]  # every instance is part 0
    instance = apart + 2.5 * turn + 0.1 * semantic
    confidence = instance * np.exp(score) - score
    for name, values in (("center", apart), ("rotation", turn), ("semantic", semantic), ("confidence", confidence)):
        np.testing.assert_allclose(terms[name].detach(), values[positive].mean(), rtol=1e-3, err_msg=name)
    moved, scored = torch.autograd.grad(terms["confidence"], [poses.center, poses.score], allow_unused=True)
    assert (moved is None) == detach
    # d/ds (L e^s - s) = L c - 1: the best confidence of Eq. (10) is c = 1 / L.
    expected = np.where(positive, (instance * np.exp(score) - 1) / positive.sum(), 0)
    np.testing.assert_allclose(scored, expected, rtol=1e-3, atol=1e-4)


def test_one_class_has_no_semantic_term(make_box: Callable, batch: Batch, assigned: Assignment) -> None:
    poses = poses_of(*near_truth(batch, assigned, 0))
    terms = AttentionVoteLoss(make_box(), WEIGHTS, LossSettings()).proposal_terms(poses, assigned, batch)
    assert terms.keys() == {"center", "rotation"}


def test_a_body_of_revolution_refuses_a_share_of_d_that_it_would_ignore(make_box: Callable) -> None:
    gear, bolt, box = make_box(Symmetry("revolution")), make_box(Symmetry("revolution", flip=True)), make_box()
    sentence = (
        r"^loss\.settings\.isotropic must be left at 0\.1 or be 0 for box, a body of revolution, which it does not "
        r"change: there is no Lambda that it could be added to, got 0\.3$"
    )
    with pytest.raises(ValueError, match=sentence):
        AttentionVoteLoss(gear, WEIGHTS, LossSettings(isotropic=0.3))
    tables = [
        AttentionVoteLoss(gear, WEIGHTS, LossSettings(isotropic=share)).training_pose.each[0].representation
        for share in (0.0, LossSettings().isotropic)
    ]
    torch.testing.assert_close(*tables, rtol=0, atol=0)
    check_isotropic(LossSettings(isotropic=0.3), box)
    check_isotropic(LossSettings(isotropic=0.3), PartSet("mixed", (gear, replace(box, name="other"))))
    with pytest.raises(ValueError, match="for round, a set of bodies of revolution, which"):
        check_isotropic(LossSettings(isotropic=0.05), PartSet("round", (gear, replace(bolt, name="bolt"))))


def test_refined_term_is_the_evaluations_distance_in_tenths_of_the_diameter(
    make_box: Callable, batch: Batch, assigned: Assignment
) -> None:
    part: Part = make_box(Symmetry("dihedral", order=2))
    rotation, center = near_truth(batch, assigned, 3)
    loss = AttentionVoteLoss(part, WEIGHTS, LossSettings(isotropic=0.0))
    term = loss.refined_term(poses_of(rotation, center), assigned, batch)
    expected = distances(part, batch, assigned, rotation, center)[assigned.positive.numpy()].mean() / 0.01
    np.testing.assert_allclose(term, expected, rtol=1e-3)


def distances(part: Part, batch: Batch, assigned: Assignment, rotation: np.ndarray, center: np.ndarray) -> np.ndarray:
    at = assigned.sample, assigned.instance
    truth = transform(batch.rotation[at].double().numpy(), batch.center[at].double().numpy())
    return np.diagonal(PoseMetric.of(part).distances(transform(rotation, center), truth))


def test_quality_is_the_share_of_thresholds_met_and_duplicates_get_none(
    make_box: Callable, batch: Batch, assigned: Assignment
) -> None:
    loss = AttentionVoteLoss(make_box(), WEIGHTS, LossSettings())
    at = assigned.sample, assigned.instance
    rotation, center = batch.rotation[at].double().numpy(), batch.center[at].double().numpy()
    # Rows 1 and 2 are on one instance; row 4 is not positive, though its pose is exact and shares row 3's instance.
    center[:, 0] += [0.0015, 0.003, 0.001, 0.007, 0.0, 0.02]
    quality = loss.quality(poses_of(rotation, center), assigned, batch)
    np.testing.assert_allclose(quality, [1.0, 0.0, 1.0, 1 / 3, 0.0, 0.0], atol=1e-6)
    scores = np.array([0.5, -1.0, 2.0, 0.0, 1.0, -2.0])
    poses = poses_of(rotation, center, scores)
    probability, target = 1 / (1 + np.exp(-scores)), quality.numpy()
    expected = -(target * np.log(probability) + (1 - target) * np.log(1 - probability)).mean()
    np.testing.assert_allclose(loss.quality_term(poses, assigned, batch)["confidence"], expected, rtol=1e-5)


def test_quality_judges_each_for_itself_where_the_network_merges(
    make_box: Callable, batch: Batch, assigned: Assignment
) -> None:
    loss = AttentionVoteLoss(make_box(), WEIGHTS, LossSettings(one_per_instance=False))
    at = assigned.sample, assigned.instance
    rotation, center = batch.rotation[at].double().numpy(), batch.center[at].double().numpy()
    center[:, 0] += [0.0015, 0.003, 0.001, 0.007, 0.0, 0.02]
    quality = loss.quality(poses_of(rotation, center), assigned, batch)
    np.testing.assert_allclose(quality, [1.0, 2 / 3, 1.0, 1 / 3, 0.0, 0.0], atol=1e-6)


def test_quality_knows_the_symmetry(make_box: Callable, batch: Batch, assigned: Assignment) -> None:
    part: Part = make_box(Symmetry("cyclic", order=2))
    at = assigned.sample, assigned.instance
    turned = batch.rotation[at].double().numpy() @ part.symmetry.rotations()[1]
    poses = poses_of(turned, batch.center[at].double().numpy())
    single = assigned._replace(positive=torch.tensor([True, True, False, True, False, True]))
    expected = torch.tensor([1.0, 1, 0, 1, 0, 1])
    torch.testing.assert_close(AttentionVoteLoss(part, WEIGHTS, LossSettings()).quality(poses, single, batch), expected)
    none = AttentionVoteLoss(make_box(), WEIGHTS, LossSettings()).quality(poses, single, batch)
    assert none.max() < 1


def test_total_is_the_weighted_sum_and_the_ramp_spares_the_votes(make_box: Callable) -> None:
    loss = AttentionVoteLoss(make_box(), {"vote": 2.0, "vote_rotation": 0.5, "center": 3.0}, LossSettings())
    terms = {k: torch.tensor(v) for k, v in {"vote": 1.0, "vote_rotation": 4.0, "center": 10.0, "refined": 7.0}.items()}
    assert loss.total(terms).item() == pytest.approx(2 + 2 + 30)
    assert loss.total(terms, 0.1).item() == pytest.approx(2 + 2 + 3)


def test_masked_mean_of_nothing_is_zero_and_ignores_what_is_masked() -> None:
    values = torch.tensor([1.0, float("nan"), 3.0], requires_grad=True)
    mask = torch.tensor([True, False, True])
    assert masked_mean(values, mask).item() == 2.0
    (gradient,) = torch.autograd.grad(masked_mean(values, mask), values)
    torch.testing.assert_close(gradient, torch.tensor([0.5, 0, 0.5]))
    empty = masked_mean(values, torch.zeros(3, dtype=torch.bool))
    assert empty.item() == 0.0


def one_place(batch: Batch, model: AttentionVote) -> Batch:
    """All points of every sample at one place."""
    points = torch.full_like(batch.points, 0.25)
    found = [find_neighborhoods(p.numpy(), model.layout) for p in points]
    return batch._replace(points=points, neighborhoods=type(found[0]).stack(found))


def lonely(batch: Batch, model: AttentionVote) -> Batch:
    """Points so far apart that every ball holds one."""
    points = batch.points * 100
    found = [find_neighborhoods(p.numpy(), model.layout) for p in points]
    return batch._replace(points=points, neighborhoods=type(found[0]).stack(found))


CASES = ["instances", "one instance", "no instance", "a sample without", "invisible", "one place", "lonely points"]


@pytest.mark.parametrize("preset", ["ours", "paper"])
@pytest.mark.parametrize("case", CASES)
def test_losses_and_gradients_are_finite_whatever_is_missing(
    make_box: Callable, make_network: Callable, make_sample: Callable, case: str, preset: str
) -> None:
    paper = {"rotation": "quaternion", "confidence": "exponential", "refinement": None, "vote_rotation": False}
    model = make_network(**(paper if preset == "paper" else {})).train()
    loss = AttentionVoteLoss(make_box(), PAPER if preset == "paper" else WEIGHTS,
                             PAPER_SETTINGS if preset == "paper" else LossSettings())  # fmt: skip
    numbers = {"one instance": (1, 1), "no instance": (0, 0), "a sample without": (2, 0)}.get(case, (3, 2))
    visible = 0.0 if case == "invisible" else 1.0
    batch = collate([make_sample(11 + i, n, visible=visible) for i, n in enumerate(numbers)])
    if case == "one place":
        batch = one_place(batch, model)
    if case == "lonely points":
        batch = lonely(batch, model)
    terms = batch_loss(model, loss, batch, ramp=1.0, least_heat=0.0)
    assert {"vote", "center", "rotation", "confidence"} <= terms.keys()
    assert ("refined" in terms) == (preset == "ours")
    assert all(v.isfinite() for v in terms.values()), terms
    loss.total(terms).backward()
    gradients = [p.grad for p in model.parameters() if p.grad is not None]
    assert gradients
    assert all(g.isfinite().all() for g in gradients)
    if case in ("no instance", "invisible"):
        assert terms["center"].item() == terms["rotation"].item() == 0.0
    if case == "no instance":
        assert terms["vote"].item() == 0.0


def test_peaks_without_heat_are_left_out_and_too_few_leave_the_votes_alone(
    make_box: Callable, make_network: Callable, make_scenes: Callable
) -> None:
    model, batch = make_network().train(), make_scenes(2, 1)
    loss = AttentionVoteLoss(make_box(), WEIGHTS, LossSettings())
    assert batch_loss(model, loss, batch, ramp=0.0, least_heat=0.1).keys() == {"vote", "vote_rotation"}
    assert batch_loss(model, loss, batch, ramp=1.0, least_heat=1e9).keys() == {"vote", "vote_rotation"}


def test_rows_per_scene_bounds_what_is_trained_on(
    make_box: Callable, make_network: Callable, make_scenes: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, batch = make_network().train(), make_scenes(2, 3)
    seen = []
    regress = model.regress
    monkeypatch.setattr(model, "regress", lambda votes, peaks, rows: seen.append(rows) or regress(votes, peaks, rows))
    for most in (1000, 2, 2):
        loss = AttentionVoteLoss(make_box(), WEIGHTS, LossSettings(rows_per_scene=most))
        batch_loss(model, loss, batch, ramp=1.0, least_heat=0.01)
    everything, some, again = seen
    assert len(everything) > 4 >= len(some) > 0
    assert set(some.tolist()) < set(everything.tolist())
    assert again.tolist() == some.tolist()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda part: AttentionVoteLoss(part, {"vote": 1.0, "centre": 1.0, "a": 2.0}, LossSettings()),
            "loss weights must be among vote, vote_rotation, center, rotation, semantic, confidence, refined, "
            "got a, centre",
        ),
        (lambda _: LossSettings(rotation="euler"), "rotation must be one of metric, .*; got 'euler'"),
        (
            lambda _: LossSettings(confidence="none"),
            "confidence must be one of exponential, quality; got 'none'",
        ),
    ],
)
def test_unknown_names_are_refused(make_box: Callable, make: Callable, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make(make_box())
