"""Proof of equality in task units: the same scenes through the checkpoint and through the exported graph.

What a robot does with a model depends on its poses, so poses are compared, not tensors: every detection of one side
must have its partner on the other, at most some hundredths of a millimetre and of a degree away, with the same
confidence; and the average precision of both must be the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from attentionvote.data.samples import Batch
from attentionvote.evaluation import PoseMetric, SceneResult, evaluate, rotation_errors
from attentionvote.export.parity_record import NAMES, Parity
from attentionvote.model.network import AttentionVote
from attentionvote.model.predictions import Predictions
from attentionvote.part import Parts
from attentionvote.training.detections import scene_results

Arrays = Mapping[str, NDArray[np.float32]]
Graph = Callable[[NDArray[np.float32], NDArray[np.float32]], Arrays]
PARTNER = 0.05  # share of D within which a pose of the other side is the same detection


def measure_parity(
    model: AttentionVote,
    graph: Graph,
    samples: Iterable[Batch],
    part: Parts,
    peak_threshold: float,
    confidence_threshold: float,
) -> Parity:
    """Run checkpoint and graph on the same samples and compare what they find.

    Args:
        model: the network of the checkpoint, in evaluation.
        graph: the exported file in its runtime: ``points``, ``normals`` ``(1, N, 3)`` to the outputs by name.
        samples: batches of one, of scenes that were held out.
        part: for distances and symmetries; or the set of parts.
        peak_threshold, confidence_threshold: what counts as a detection.

    Raises:
        ValueError: when an output of the graph is not finite.
    """
    sides: tuple[list[SceneResult], list[SceneResult]] = ([], [])
    for batch in samples:
        with torch.no_grad():
            sides[0].extend(
                scene_results(model(batch.points, batch.normals, batch.neighborhoods), batch, peak_threshold)
            )
        outputs = graph(batch.points.numpy(), batch.normals.numpy())
        for name, values in outputs.items():
            if not np.isfinite(values).all():
                raise ValueError(f"the graph's {name} must be finite, got NaN or inf in scene {len(sides[1])}")
        theirs = Predictions(**{name: torch.from_numpy(outputs[name]) for name in Predictions._fields})
        sides[1].extend(scene_results(theirs, batch, peak_threshold))
    return compare(sides[0], sides[1], part, confidence_threshold)


def compare(
    ours: Sequence[SceneResult], theirs: Sequence[SceneResult], part: Parts, confidence_threshold: float
) -> Parity:
    """Differences between two answers to the same scenes.

    A detection (confidence at the threshold or above) may find its partner among all proposals of the other side: one
    that stands a rounding error below the threshold is a partner still. Of a set of parts, partners have one name.
    """
    metrics = [PoseMetric.of(member) for member in part.parts]
    shift, turn, trust, unmatched = [np.zeros(0)], [np.zeros(0)], [np.zeros(0)], [0]
    for whole_a, whole_b in zip(ours, theirs, strict=True):
        lonely = 0
        in_scene = [np.zeros(0)]
        for k, (member, metric) in enumerate(zip(part.parts, metrics, strict=True)):
            a, b = whole_a.of_part(k), whole_b.of_part(k)
            i, j = _partners(metric, a, b, PARTNER * member.diameter)
            sure_a, sure_b = a.scores >= confidence_threshold, b.scores >= confidence_threshold
            lonely += int(sure_a.sum() - sure_a[i].sum() + sure_b.sum() - sure_b[j].sum())
            sure = sure_a[i] | sure_b[j]
            i, j = i[sure], j[sure]
            in_scene.append(1000 * np.linalg.norm(a.poses[i, :3, 3] - b.poses[j, :3, 3], axis=-1))
            turn.append(np.degrees(rotation_errors(a.poses[i], b.poses[j], member.symmetry)))
            trust.append(np.abs(a.scores[i] - b.scores[j]))
        shift.append(np.concatenate(in_scene))
        unmatched.append(lonely)
    shifts, turns, trusts = (np.concatenate(values) for values in (shift, turn, trust))
    figures = [evaluate(side, part, add=False) for side in (ours, theirs)]
    return Parity(
        scenes=len(ours),
        pairs=len(shifts),
        unmatched=sum(unmatched),
        translation_mm=float(shifts.max(initial=0.0)),
        translation_p99_mm=_percentile(shifts),
        rotation_degrees=float(turns.max(initial=0.0)),
        rotation_p99_degrees=_percentile(turns),
        confidence=float(trusts.max(initial=0.0)),
        confidence_p99=_percentile(trusts),
        ap={name: (float(figures[0][name]), float(figures[1][name])) for name in NAMES},
        worst_scene=int(np.argmax([values.max(initial=0.0) for values in shift[1:]])) if ours else 0,
        unmatched_scenes=tuple(i for i, count in enumerate(unmatched[1:]) if count),
    )


def _partners(
    metric: PoseMetric, a: SceneResult, b: SceneResult, limit: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of nearest poses, at most ``limit`` metres apart."""
    if not (len(a.poses) and len(b.poses)):
        nothing = np.zeros(0, dtype=np.int64)
        return nothing, nothing
    distances = metric.distances(a.poses, b.poses)
    i, j = linear_sum_assignment(np.minimum(distances, 2 * limit))
    near = distances[i, j] <= limit
    return i[near], j[near]


def _percentile(values: NDArray[np.float64]) -> float:
    return float(np.percentile(values, 99)) if len(values) else 0.0
