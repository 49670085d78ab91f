"""Measurement of models on the frozen evaluation set: exported bundles through the estimator that cells run.

The set has drop cycles of its own, which no training, validation or test has seen, and one digest of everything that
makes its clouds. Several models are measured in one go, scene by scene, so that nothing but the model differs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from attentionvote.evaluation import LeftOut, SceneResult, evaluate_at, left_out_figures
from attentionvote.evaluation.scene_result import Array
from attentionvote.inference import Bundle, Estimate, PoseEstimator
from attentionvote.measurement.scenes import MeasuredScenes
from attentionvote.part import Parts
from attentionvote.scene import Scene


@dataclass(frozen=True)
class Measurement:
    """What one model found, and how long it took.

    Attributes:
        bundle: digest of the model's bundle.
        results: all proposals and the truth of every scene, in the set's order.
        cycles: ``(S,)`` which drop cycle each scene is of.
        working_point: confidence from which on the model itself calls a proposal a detection.
        seconds: ``(S,)`` of one estimate each, preparation included.
    """

    bundle: str
    results: list[SceneResult] = field(repr=False)
    cycles: NDArray[np.int64] = field(repr=False)
    working_point: float
    seconds: Array = field(repr=False)

    def figures(self, part: Parts) -> dict[str, float]:
        """Flat figures: ``evaluation.evaluate_at``, and ``latency_p50_ms``, ``latency_p95_ms``."""
        p50, p95 = (1000 * float(np.percentile(self.seconds, q)) for q in (50, 95))
        figures = evaluate_at(self.results, part, self.working_point)
        return figures | {"latency_p50_ms": p50, "latency_p95_ms": p95}

    def left_out(self, part: Parts) -> dict[str, LeftOut]:
        """Figures with their intervals, see ``evaluation.left_out_figures``; none of a set of one drop cycle."""
        return left_out_figures(self.results, self.cycles, part, self.working_point)


def measure(
    bundles: Sequence[Bundle],
    scenes: MeasuredScenes,
    threads: int = 1,
    shown: Callable[[Iterator[Scene]], Iterable[Scene]] = iter,
    peak_threshold: float | None = None,
) -> list[Measurement]:
    """Measure models side by side: each scene is read once and answered by every model, in turning order.

    The estimator is the cell's, but for one thing: it is asked for all proposals, because average precision is an area
    over all confidences. Whether one is a detection is decided afterwards, by the same rule.

    Args:
        bundles: verified bundles of the set's part.
        scenes: the scenes.
        threads: of an estimate.
        shown: wraps the scenes, such as a progress bar.
        peak_threshold: heat that a peak needs, in place of what each model asks for.

    Raises:
        ValueError: when a bundle is of another part, or an estimator refuses a cloud.
    """
    for bundle in bundles:
        if bundle.card.part.digest != scenes.part.digest:
            raise ValueError(
                f"bundle {bundle.digest[:12]} must be of part {scenes.part.name} {scenes.part.digest[:12]}, got "
                f"{bundle.card.part.name} {bundle.card.part.digest[:12]}: the part has changed, train it again"
            )
    estimators = [_all_proposals(bundle, threads, peak_threshold) for bundle in bundles]
    scene_results: list[list[SceneResult]] = [[] for _ in bundles]
    seconds: list[list[float]] = [[] for _ in bundles]
    for number, cloud in enumerate(shown(scenes.clouds())):
        occlusion = 1.0 - np.minimum(cloud.visible_fraction, 1.0)
        for turn in range(len(bundles)):
            which = (number + turn) % len(bundles)
            if not seconds[which]:  # the first call of a session also plans its memory
                estimators[which].estimate_parts_only(cloud.points)
            answer = estimators[which].estimate_parts_only(cloud.points)
            detections = answer.detections if isinstance(answer, Estimate) else ()
            poses = np.array([d.camera_from_part for d in detections]).reshape(-1, 4, 4)
            scores = np.array([d.confidence for d in detections])
            named = np.array([bundles[which].card.classes.index(d.part) for d in detections], dtype=np.int64)
            truth = cloud.camera_from_part, occlusion
            scene_results[which].append(SceneResult(poses, scores, *truth, named, cloud.part_ids))
            seconds[which].append(answer.seconds["total"])
    for estimator in estimators:
        estimator.close()
    return [
        Measurement(bundle.digest, results, scenes.cycle_of_scene, bundle.card.confidence_threshold, np.array(times))
        for bundle, results, times in zip(bundles, scene_results, seconds, strict=True)
    ]


def _all_proposals(bundle: Bundle, threads: int, peak_threshold: float | None) -> PoseEstimator:
    card = replace(bundle.card, confidence_threshold=0.0)
    if peak_threshold is not None:
        card = replace(card, peak_threshold=peak_threshold)
    return PoseEstimator(replace(bundle, card=card), threads=threads)
