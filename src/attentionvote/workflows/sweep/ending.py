"""The end of a sweep: figures of its trials, the best settings as an experiment, the JSON line."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from optuna.trial import TrialState

from attentionvote.command.conf_folder import new_file
from attentionvote.files import write_whole
from attentionvote.workflows.sweep.figures import figures_page
from attentionvote.workflows.sweep.report import experiment_text, importances, run_of, write_table
from attentionvote.workflows.sweep.study import Ledger

if TYPE_CHECKING:
    from attentionvote.tracking.run import Run

log = logging.getLogger("attentionvote.sweep")


def report(
    ledger: Ledger, parent: Run, part: str, base: Sequence[str], folder: Path, save_as: str | None
) -> dict[str, Any]:
    """Leave everything in the study's folder and in its run; the JSON line.

    Args:
        ledger: of the study.
        parent: the study's run in MLflow.
        part: that was trained.
        base: words of the training that was varied.
        folder: of the study.
        save_as: name of an experiment to write besides.

    Raises:
        ValueError: when no trial is complete, with the reason of the last that failed.
    """
    best, study = ledger.best, ledger.study.study_name
    for path in write_table(ledger, folder):
        parent.log_file(path.name, path)
    counts = {state.name.lower(): ledger.count(state) for state in TrialState if ledger.count(state)}
    parent.log_tags({f"sweep.{state}": count for state, count in counts.items()})
    failed = [
        {"trial": trial.number, "reason": trial.user_attrs.get("reason")}
        for trial in ledger.trials
        if trial.state == TrialState.FAIL
    ]
    for failure in failed:
        log.warning("trial %d failed: %s", failure["trial"], failure["reason"])
    if best is None:
        why = f"trial {failed[-1]['trial']}: {failed[-1]['reason']}" if failed else "all were pruned"
        raise ValueError(
            f"a sweep must have at least one complete trial, but of {len(ledger.trials)} trials {len(failed)} "
            f"failed and none is complete; {why}"
        )
    complete = [trial for trial in ledger.trials if trial.state == TrialState.COMPLETE]
    shares = importances(ledger)
    if not shares:
        log.info("what matters most cannot be told from %d complete trials", len(complete))
    write_whole(folder / "trials.html", figures_page(ledger.study, bool(shares)))
    parent.log_file("trials.html", folder / "trials.html")
    values = {s.name: s.value(best.params[s.name]) for s in ledger.space}
    title = f"Trial {best.number} of the sweep {study}: val/ap {best.value:.4f}, best of {len(complete)}."
    text = experiment_text(base, values, title)
    paths = [folder / "best.yaml", folder.parent / "best.yaml"]
    if save_as:
        paths.append(new_file("experiment", save_as))
    for path in paths:
        write_whole(path, text)
    parent.log_file("best.yaml", paths[0])
    log.info("best: trial %d, val/ap %.4f; its settings are in %s", best.number, best.value, paths[-1])
    return {
        "stage": "sweep",
        "object": part,
        "study": study,
        "run_id": parent.id,
        "trials": len(ledger.trials),
        "states": counts,
        "best": {"trial": best.number, "val_ap": best.value, "run_id": run_of(best), "values": values},
        "importance": {name: round(share, 4) for name, share in shares.items()},
        "experiment": str(paths[-1]),
        "folder": str(folder),
        "failed": failed,
    }
