"""The figures of an evaluation: as one dictionary, as a table for people, in the MLflow run of the training."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from attentionvote.command.tables import show_table
from attentionvote.measurement.figures import figures_of, machine
from attentionvote.workflows.evaluate.frozen_set import is_recorded

if TYPE_CHECKING:
    from attentionvote.measurement.models import Measurement
    from attentionvote.measurement.scenes import MeasuredScenes
    from attentionvote.workflows.evaluate.job import EvaluationJob

log = logging.getLogger("attentionvote.evaluate")
_TITLES = {
    "ap_10": "AP at 10 % D",
    "ap_5": "AP at 5 % D",
    "ap_2": "AP at 2 % D",
    "precision_10": "precision at 10 % D",
    "recall_10": "recall at 10 % D",
}


def described(job: EvaluationJob, frozen: MeasuredScenes, measured: Measurement) -> dict[str, Any]:
    """What was measured, and on what: the dictionary of the JSON line.

    For figures see ``figures_of``; ``scene_set`` is the digest of generated scenes without the sensor, None of a
    dataset's; ``frozen`` is whether the scenes are those whose digest is recorded, None without.
    """
    from attentionvote.measurement.scenes import EvaluationSet

    return {
        "stage": "evaluate",
        "object": job.part.name,
        "bundle": measured.bundle,
        "run_id": job.bundle.card.run_id,
        "signed_by": job.signer,
        "evaluation_set": frozen.digest,
        "scene_set": frozen.scenes.digest if isinstance(frozen, EvaluationSet) else None,
        "frozen": is_recorded(job.cfg, job.part, frozen),
        "sensor": frozen.title,
        "scenes": len(frozen),
        **figures_of(measured, job.part),
        "threads": job.cfg.evaluation.threads,
        "machine": machine(),
    }


def show(result: Mapping[str, Any]) -> None:
    """A table on stderr."""
    figures, sure = result["figures"], result["intervals"]
    head = f"{result['object']}, bundle {result['bundle'][:12]}, {result['scenes']} scenes"
    columns = ("figure", "value", "95 % interval" if sure else "one cycle, no interval")
    within = {name: "{:.3f} to {:.3f}".format(*sure[name]) if name in sure else "" for name in _TITLES}
    rows = [(title, f"{figures[name]:.4f}", within[name]) for name, title in _TITLES.items()]
    for name, value in figures.items():
        if name.startswith("recall_visible_"):
            low, high = name.split("_")[-2:]
            rows.append((f"recall, {low}-{high} % visible", f"{value:.4f}", ""))
    for name, title, unit in (("center_error_mm", "centre, median", "mm"), ("rotation_error_deg", "turn, median", "°")):
        if name in figures:
            rows.append((title, f"{figures[name]:.2f} {unit}", ""))
    rows.append(("an estimate, p50 / p95", "{latency_p50_ms:.0f} / {latency_p95_ms:.0f} ms".format(**figures), ""))
    show_table(columns, rows, head, numbers=columns[1:])


def record(store: str | None, run_id: str, result: Mapping[str, Any], name: str, figures: bool) -> None:
    """Write the figures into the training's run; a store that does not have it costs a warning, not the figures.

    Args:
        store: of MLflow.
        run_id: of the training.
        result: of ``described``.
        name: of the file that it becomes.
        figures: whether they are the run's ``evaluation/...`` too, or of other scenes and only in the file.
    """
    from attentionvote.tracking.finished_run import add_to_run

    metrics, tags = {}, {}
    if figures:
        metrics = {f"evaluation/{name}": value for name, value in result["figures"].items()}
        for figure, (low, high) in result["intervals"].items():
            metrics |= {f"evaluation/{figure}_low": low, f"evaluation/{figure}_high": high}
        tags = {"evaluation.bundle": result["bundle"], "evaluation.set": result["evaluation_set"]}
    try:
        if not run_id:
            raise ValueError("the model's card names no run")
        add_to_run(store, run_id, metrics, tags, {f"evaluation/{name}": json.dumps(result, indent=2)})
    except (ValueError, OSError) as error:
        log.warning("the figures are not in the training's run, the same command tries again: %s", error)
