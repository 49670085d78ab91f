"""A batch shared by processes: losses, gradients, choice of proposals and validation are those of one process."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from attentionvote.data.samples import Batch
from attentionvote.evaluation import SceneResult, evaluate
from attentionvote.geometry.pose import transform
from attentionvote.model.neighborhoods import Neighborhoods
from attentionvote.model.network import AttentionVote
from attentionvote.part import Part
from attentionvote.training.losses import AttentionVoteLoss
from attentionvote.training.module import PoseTraining
from attentionvote.training.processes import summed
from attentionvote.training.schedule import Schedule
from attentionvote.training.settings import LossSettings
from attentionvote.training.step import batch_loss
from attentionvote.training.synced_norm import RowNormSync

InProcesses = Callable[[int, Callable[..., Any]], list[Any]]
WEIGHTS = dict(zip(AttentionVoteLoss.TERMS, (2.0, 0.5, 1.0, 1.5, 0.1, 1.0, 1.2), strict=True))


def scenes_of(batch: Batch, chosen: range) -> Batch:
    keep = torch.tensor(chosen)
    levels = (tuple(level[keep] for level in levels) for levels in batch.neighborhoods[1:])
    found = Neighborhoods(batch.neighborhoods.order[keep], *levels)
    return Batch(**{n: getattr(batch, n)[keep] for n in Batch._fields if n != "neighborhoods"}, neighborhoods=found)


def step(
    model: AttentionVote, loss: AttentionVoteLoss, batch: Batch, silent: set[int], first_scene: int
) -> tuple[dict[str, float], dict[str, Tensor]]:
    """Terms of the whole batch and this process's gradients; the scenes ``silent`` have no proposals."""
    find_peaks = model.find_peaks

    def without(votes: Any) -> Any:
        peaks = find_peaks(votes)
        heat = peaks.heat.clone()
        for scene in silent:
            if 0 <= scene - first_scene < len(heat):
                heat[scene - first_scene] = 0
        return peaks._replace(heat=heat)

    model.find_peaks = without  # type: ignore[method-assign]
    terms = batch_loss(model, loss, batch, ramp=1.0, least_heat=0.0)
    loss.total(terms, 0.7).backward()
    values = summed(torch.stack(list(terms.values()))).tolist()
    gradients = {n: torch.zeros_like(p) if p.grad is None else p.grad for n, p in model.named_parameters()}
    return dict(zip(terms, values, strict=True)), gradients | dict(model.named_buffers())


@pytest.mark.parametrize(
    ("rows_per_scene", "silent", "confidence"),
    [(64, set(), "quality"), (2, set(), "quality"), (3, {2, 3}, "quality"), (64, {0, 1}, "exponential")],
    ids=["all", "every n-th row", "second process without proposals", "first without, Eq. 10"],
)
def test_two_processes_compute_what_one_does(
    in_processes: InProcesses,
    make_network: Callable[..., AttentionVote],
    make_scenes: Callable[..., Batch],
    make_box: Callable[..., Part],
    rows_per_scene: int,
    silent: set[int],
    confidence: str,
) -> None:
    # Rounding of the sixteenth digit cannot be mistaken for an error of the third.
    batch = make_scenes(3, 1, 2, 1).to("cpu", torch.float64)
    choices = LossSettings(confidence=confidence, rows_per_scene=rows_per_scene, assignment=1.0)  # type: ignore[arg-type]

    def made() -> tuple[AttentionVote, AttentionVoteLoss]:
        model = make_network(confidence=confidence, **({"refinement": None} if confidence != "quality" else {}))
        return model.double().train(), AttentionVoteLoss(make_box(), WEIGHTS, choices)

    def share(rank: int) -> Any:
        model, loss = made()
        RowNormSync().apply(model)
        return step(model, loss, scenes_of(batch, range(2 * rank, 2 * rank + 2)), silent, 2 * rank)

    terms, gradients = step(*made(), batch, silent, 0)
    shares = in_processes(2, share)
    assert {"center", "rotation", "confidence"} <= set(terms)
    assert terms["center"] > 0
    for told, _ in shares:  # all processes log the same, and what one logs
        assert told == pytest.approx(terms, rel=1e-9)
    for name, whole in gradients.items():
        if name in dict(made()[0].named_buffers()):
            assert all(torch.equal(own[name], shares[0][1][name]) for _, own in shares), name
            torch.testing.assert_close(shares[0][1][name], whole, rtol=1e-9, atol=1e-12)
        else:
            torch.testing.assert_close(sum(own[name] for _, own in shares), whole, rtol=1e-7, atol=1e-10)
    assert sum(float(g.abs().sum()) for n, g in gradients.items() if n.startswith("fusion")) > 0


def found_in(scenes: int, part: Part) -> list[SceneResult]:
    """Results that are right, near, wrong, doubled and missing, with equal confidences across scenes."""
    rng, results = np.random.default_rng(3), []
    for i in range(scenes):
        truth = transform(np.broadcast_to(np.eye(3), (3, 3, 3)), rng.uniform(-0.2, 0.2, (3, 3)))
        poses = truth[rng.integers(0, 3, 4)].copy()
        poses[:, 0, 3] += rng.choice([0.0, 0.03, 0.07, 0.5], 4) * part.diameter
        results.append(SceneResult(poses, rng.choice([0.2, 0.5, 0.9], 4), truth, np.zeros(3) + 0.3 * (i % 2)))
    return results


def test_validation_counts_every_scene_once(
    in_processes: InProcesses, make_network: Callable[..., AttentionVote], make_box: Callable[..., Part]
) -> None:
    part = make_box()
    results, cuts = found_in(7, part), (0, 3, 5, 7)

    def share(rank: int) -> dict[str, float]:
        module = PoseTraining(make_network(), AttentionVoteLoss(part, WEIGHTS, LossSettings()), part, Schedule())
        module.results = results[cuts[rank] : cuts[rank + 1]]
        logged: dict[str, float] = {}
        module.log_dict = logged.update  # type: ignore[method-assign,assignment]
        module.log = logged.__setitem__  # type: ignore[method-assign,assignment]
        module.on_validation_epoch_end()
        return logged

    whole = {f"val/{name}": value for name, value in evaluate(results, part, add=False).items()}
    whole["val/ap"] = (whole["val/ap_10"] + whole["val/ap_5"] + whole["val/ap_2"]) / 3
    assert 0.1 < whole["val/ap"] < 0.9
    assert in_processes(3, share) == [whole] * 3  # to the last bit: the checkpoints of all processes agree
