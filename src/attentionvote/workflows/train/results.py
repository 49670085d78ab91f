"""What a finished training is worth: figures of the test scenes, pictures, the model file, the JSON line."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, NamedTuple

import lightning as L
import torch
from rich.console import Console
from rich.progress import track

from attentionvote.data.datamodule import PartDataModule
from attentionvote.evaluation import PoseMetric, SceneResult, average_precision, curves, evaluate_at
from attentionvote.evaluation.scores import HEADLINES, THRESHOLDS
from attentionvote.training.checkpoint import load_weights, save_trained
from attentionvote.training.losses import AttentionVoteLoss
from attentionvote.training.module import PoseTraining
from attentionvote.training.operating_point import best_threshold
from attentionvote.training.pictures import picture_inputs
from attentionvote.training.processes import in_order
from attentionvote.training.proposal_counts import ProposalCounts, proposal_figures

log = logging.getLogger("attentionvote.train")
FIGURES = "test/figures.json"
_LEAST_HISTORY = 10  # logged steps from which on it can be said whether a loss fell


class SplitDetections(NamedTuple):
    """What was found in the scenes of a split, and how the proposals cover them; scene by scene."""

    results: list[SceneResult]
    proposals: list[ProposalCounts]


def detect_everything(
    module: PoseTraining, data: PartDataModule, weights: Path, device: torch.device
) -> dict[str, SplitDetections]:
    """What the weights of a checkpoint find in all validation and test scenes, by split.

    Every process looks at its share; the first one gets all, in the order of the scenes, the others get empty lists.
    """
    load_weights(module, weights)
    module.eval().to(device)
    detections = {}
    for name in ("val", "test"):
        pairs = in_order(_detect(module, data, name, device))
        detections[name] = SplitDetections([result for result, _ in pairs], [counts for _, counts in pairs])
    return detections


def assess(
    module: PoseTraining,
    data: PartDataModule,
    detections: dict[str, SplitDetections],
    model_file: Path,
    tracked: Any,
    step: int,
) -> dict[str, Any]:
    """Judge what was found in scenes never seen, log the figures, write ``model_file``; for the first process.

    The headlines become metrics of the run, all figures the table ``test/figures.json``.

    The confidence threshold is chosen on the validation scenes.

    Returns:
        ``metrics`` (see ``attentionvote.evaluation.evaluate_at``; precision and recall at the threshold; and
        ``training.proposal_counts.proposal_figures``), ``confidence_threshold`` and ``test_scenes``.
    """
    results = detections["test"].results
    threshold = best_threshold(detections["val"].results, module.part)
    metrics = evaluate_at(results, module.part, threshold) | proposal_figures(detections["test"].proposals)
    headlines = {f"test/{name}": metrics[name] for name in HEADLINES if name in metrics}
    tracked.log_metrics(headlines | {"test/confidence_threshold": threshold}, step)
    tracked.log_table(FIGURES, [{"figure": name, "value": value} for name, value in metrics.items()])
    metadata = module.metadata | {"confidence_threshold": threshold, "test": metrics}
    save_trained(module.model, metadata, model_file)
    tracked.log_file("checkpoints/model.ckpt", model_file)
    _draw(module, data, results, threshold, tracked)
    return {
        "confidence_threshold": threshold,
        "test_scenes": len(results),
        "metrics": {k: round(v, 4) for k, v in metrics.items()},
    }


def _detect(
    module: PoseTraining, data: PartDataModule, split: str, device: torch.device
) -> list[tuple[SceneResult, ProposalCounts]]:
    loader = data.val_dataloader() if split == "val" else data.test_dataloader()
    batches = track(loader, f"{module.part.name}: detecting, {split}", console=Console(stderr=True))
    return [pair for batch in batches for pair in module.examine(batch.to(device))]


def _draw(
    module: PoseTraining,
    data: PartDataModule,
    results: list[SceneResult],
    threshold: float,
    tracked: Any,
) -> None:
    from attentionvote.drawing.figures import ap_threshold_figure, precision_recall_figure
    from attentionvote.drawing.scene_pictures import scene_picture

    parts = module.part.parts
    by_threshold = {}
    for k, part in enumerate(parts):
        part_results, metric = [scene.of_part(k) for scene in results], PoseMetric.of(part)
        scores = {f"{100 * t:g} % D": average_precision(part_results, metric, t * part.diameter) for t in THRESHOLDS}
        lines = {label: (s.curve_recall, s.curve_precision) for label, s in scores.items()}
        areas = {label: s.ap for label, s in scores.items()}
        which = f"_{part.name}" if len(parts) > 1 else ""
        tracked.log_figure(f"test/precision_recall{which}.png", precision_recall_figure(lines, areas))
        against = curves(part_results, part)
        by_threshold[part.name if which else "test"] = against.ap
    tracked.log_figure("test/ap_threshold.png", ap_threshold_figure(against.thresholds, by_threshold))
    batch = next(iter(data.test_dataloader())).first(2).to(module.device)
    for i, inputs in enumerate(picture_inputs(module, batch, threshold)):
        tracked.log_figure(f"test/scene_{i}.png", scene_picture(**inputs, title=f"{module.part.name}, test scene {i}"))


def log_losses(tracked: Any) -> dict[str, list[float]]:
    """Draw every loss term over the whole run; by name the mean of its first and of its last tenth.

    Raises:
        ValueError: when the votes' loss did not fall: whatever was trained, it is no model.
    """
    from attentionvote.drawing.figures import loss_figure

    try:
        terms = {name: tracked.metric_history(f"train/loss/{name}") for name in AttentionVoteLoss.TERMS}
    except Exception as error:  # a store that is away never ends a training
        log.warning("the loss figure is left out: the tracking store does not answer (%s)", type(error).__name__)
        return {}
    terms = {name: history for name, history in terms.items() if history[0]}
    if terms:
        tracked.log_figure("train/losses.png", loss_figure(terms))
    ends = {}
    for name, (_, values) in terms.items():
        count = max(1, len(values) // 10)
        ends[name] = [round(sum(part) / count, 4) for part in (values[:count], values[-count:])]
    steps = terms.get("vote", ([], []))[0]
    whole = len(steps) >= _LEAST_HISTORY and steps[0] * 4 < steps[-1]  # not only the end, after a lost run
    if whole and not ends["vote"][1] < ends["vote"][0]:
        first, last = ends["vote"]
        raise ValueError(
            f"the loss of the votes must fall in a training, but it went from {first:g} to {last:g}: "
            "try a smaller trainer.learning_rate"
        )
    return ends


def best_score(trainer: L.Trainer) -> float | None:
    """The val/ap of the best checkpoint, None before any validation: what a trial is judged by."""
    score = getattr(trainer.checkpoint_callback, "best_model_score", None)
    return None if score is None else float(score)
