"""One sweep from its configuration to its report: the study, its run in MLflow, its trials, its files."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from configuration import CONF, ConfigurationError, compose
from hardware import cores
from omegaconf import DictConfig, OmegaConf
from optuna.trial import FrozenTrial, TrialState
from sweep_driver import SweepDriver
from sweep_progress import SweepProgress
from sweep_report import experiment_text, importances, run_of, write_table, write_whole
from sweep_space import parse_space
from sweep_study import Ledger, make_pruner, open_study, study_name
from training_job import find_training
from trial_place import for_trial

log = logging.getLogger("attentionvote.sweep")


class SweepJob:
    """A sweep of one part.

    Args:
        cfg: of ``conf/sweep.yaml``.
        base: words of the training that is varied.
        space: name of the file of conf/sweep that was chosen.

    Raises:
        ConfigurationError: with one sentence, when space, training or sweep cannot work.
    """

    def __init__(self, cfg: DictConfig, base: Sequence[str], space: str) -> None:
        self.cfg, self.base = cfg, list(base)
        training = compose("train", self.base)
        self.training = training
        self.part: str = training.object.name
        found = find_training(training)
        t = training.trainer
        if t.max_epochs < t.validate_every:
            raise ConfigurationError(
                f"trainer.max_epochs must be at least trainer.validate_every ({t.validate_every}), or no trial has a "
                f"val/ap; got {t.max_epochs}"
            )
        how = OmegaConf.to_container(cfg.sweep, resolve=True)
        assert isinstance(how, dict)
        self.space = parse_space(how["space"], training)
        experiment_text(self.base, {}, "")  # what cannot be written as an experiment is said now
        self.pruner = {**how["pruner"], "validate_every": t.validate_every, "max_epochs": t.max_epochs}
        self.name = study_name(self.part, space, {"training": found.directory.name, "sweep": how})
        self.folder = Path(cfg.sweeps) / self.part / self.name
        self.url = cfg.storage or f"sqlite:///{(self.folder / 'study.db').absolute()}"
        self.workers = cfg.workers or 1

    def open(self) -> None:
        """Open the study.

        Raises:
            ValueError: when its database cannot be used, or another sweep is at it.
        """
        study = open_study(self.url, self.name, self.cfg.heartbeat_s, make_pruner(**self.pruner))
        sampler = self.cfg.sweep.sampler
        self.ledger = Ledger(study, self.space, sampler.seed, sampler.random_trials, self.folder)
        self.ledger.lost()

    def run(self) -> dict[str, Any]:
        """Run what is missing and report; the JSON line.

        Raises:
            ValueError: when no trial is complete, with the reason of the last that failed.
        """
        from attentionvote.tracking.group_run import open_group

        ledger, total = self.ledger, self.cfg.trials
        lost = ledger.count(TrialState.RUNNING)
        done = len(ledger.trials) - lost
        log.info(
            "%s: %d of %d trials are done%s, %d at a time; %s", self.name, done, total,
            f", {lost} go on" if lost else "", self.workers, self.folder,
        )  # fmt: skip
        with open_group(
            self.training.tracking.store, self.part, f"sweep {self.name}", self.name,
            params={"study": self.name, **{f"space.{s.name}": ", ".join(map(str, s.extremes)) for s in self.space}},
            tags={"sweep.study": self.name, "sweep.trials": total},
            config_yaml=OmegaConf.to_yaml(self.cfg, resolve=True), parent=self.cfg.tracking.parent,
        ) as parent:  # fmt: skip
            self.parent = parent
            with SweepProgress(max(total, done + lost), done, self.workers, self.space) as progress:
                self.progress = progress
                driver = SweepDriver(
                    ledger, self.words, self.directory, self._environment, self.workers, self.cfg.retries,
                    self.cfg.heartbeat_s, self.folder / "logs", self._ended,
                )  # fmt: skip
                try:
                    driver.run(total, progress.tick)
                finally:
                    write_table(ledger, self.folder)
            return self._report()

    def words(self, values: Mapping[str, Any]) -> list[str]:
        """The words of a trial's training."""
        share = max(1, cores() // self.workers)
        threads = [] if any(w.startswith("trainer.threads=") for w in self.base) else [f"trainer.threads={share}"]
        how = ["force=false", "resume=auto", f"workers={share}", *threads, f"tracking.parent={self.parent.id}"]
        return [*self._chosen(values), *how]

    def directory(self, values: Mapping[str, Any]) -> Path:
        """The folder of a trial's training."""
        return find_training(compose("train", self._chosen(values))).directory

    def _chosen(self, values: Mapping[str, Any]) -> list[str]:
        return [*self.base, *(setting.word(values[setting.name]) for setting in self.space)]

    def _environment(self, number: int) -> dict[str, str]:
        return for_trial(self.url, self.name, number, self.cfg.heartbeat_s, self.pruner)

    def _ended(self, trial: FrozenTrial) -> None:
        from attentionvote.tracking.group_run import adopt

        best = self.ledger.best
        self.progress.ended(trial, best)
        run_id = run_of(trial)
        store = self.training.tracking.store
        if run_id is not None:
            state = trial.state.name.lower()
            tags = {"sweep.study": self.name, "sweep.trial": trial.number, "sweep.state": state}
            adopt(store, self.parent.id, run_id, tags)
        if best is not None and trial.value is not None:
            self.parent.log_metrics({"sweep/val_ap": trial.value, "sweep/best_val_ap": best.value or 0}, trial.number)
        write_table(self.ledger, self.folder)

    def _report(self) -> dict[str, Any]:
        from attentionvote.tracking.figures import importance_figure, trials_figure

        ledger, best = self.ledger, self.ledger.best
        for path in write_table(ledger, self.folder):
            self.parent.log_file(path.name, path)
        counts = {state.name.lower(): ledger.count(state) for state in TrialState if ledger.count(state)}
        self.parent.log_tags({f"sweep.{state}": count for state, count in counts.items()})
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
        figures = {
            "trials.png": trials_figure(
                {
                    state.name.lower(): _scores([trial for trial in ledger.trials if trial.state == state])
                    for state in (TrialState.COMPLETE, TrialState.PRUNED)
                }
            )
        }
        if shares:
            figures["importance.png"] = importance_figure(shares)
        else:
            log.info("what matters most cannot be told from %d complete trials", len(complete))
        for name, figure in figures.items():
            figure.savefig(self.folder / name)
            self.parent.log_file(name, self.folder / name)
        values = {s.name: s.value(best.params[s.name]) for s in self.space}
        title = f"Trial {best.number} of the sweep {self.name}: val/ap {best.value:.4f}, best of {len(complete)}."
        text = experiment_text(self.base, values, title)
        places = [self.folder / "best.yaml", self.folder.parent / "best.yaml"]
        if self.cfg.save_as:
            places.append(CONF / "experiment" / f"{self.cfg.save_as}.yaml")
        for place in places:
            write_whole(place, text)
        self.parent.log_file("best.yaml", places[0])
        log.info("best: trial %d, val/ap %.4f; its settings are in %s", best.number, best.value, places[-1])
        return {
            "stage": "sweep",
            "object": self.part,
            "study": self.name,
            "run_id": self.parent.id,
            "trials": len(ledger.trials),
            "states": counts,
            "best": {"trial": best.number, "val_ap": best.value, "run_id": run_of(best), "values": values},
            "importance": {name: round(share, 4) for name, share in shares.items()},
            "experiment": str(places[-1]),
            "folder": str(self.folder),
            "failed": failed,
        }


def _scores(trials: Sequence[FrozenTrial]) -> tuple[list[int], list[float]]:
    """Numbers and values of trials; of a pruned one the last value that it reported."""
    values = [trial.value if trial.value is not None else float("nan") for trial in trials]
    return [trial.number for trial in trials], values
