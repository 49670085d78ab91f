"""One sweep from its configuration to its report: the study, its run in MLflow, its trials, its files."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import Any

from optuna.trial import FrozenTrial, TrialState

from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.command.executors import cluster_of, cores_of_a_job, executor_of
from attentionvote.execution import RayCluster
from attentionvote.execution.hardware import gpu_of_slot, visible_gpus
from attentionvote.workflows.sweep.driver import TRAIN, SweepDriver
from attentionvote.workflows.sweep.ending import report
from attentionvote.workflows.sweep.progress import SweepProgress
from attentionvote.workflows.sweep.report import experiment_text, run_of, write_table
from attentionvote.workflows.sweep.settings import SweepSettings
from attentionvote.workflows.sweep.space import parse_space
from attentionvote.workflows.sweep.study import Ledger, make_pruner, open_study, study_name
from attentionvote.workflows.sweep.trial_place import for_trial, log_of, on_worker
from attentionvote.workflows.train.job import find_training
from attentionvote.workflows.train.settings import TrainSettings

TRIAL_JOB = Path(__file__).with_name("trial_elsewhere.py")
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

    def __init__(self, cfg: SweepSettings, base: Sequence[str], space: str) -> None:
        self.cfg, self.base = cfg, list(base)
        training = compose(TrainSettings, self.base)
        self.training = training
        self.part: str = training.object.name
        found = find_training(training)
        t = training.trainer
        if t.max_epochs < t.validate_every:
            raise ConfigurationError(
                f"trainer.max_epochs must be at least trainer.validate_every ({t.validate_every}), or no trial has a "
                f"val/ap; got {t.max_epochs}"
            )
        how = cfg.composed["sweep"]
        self.space = parse_space(how["space"], training)
        experiment_text(self.base, {}, "")  # what cannot be written as an experiment is said now
        self.pruner = {**how["pruner"], "validate_every": t.validate_every, "max_epochs": t.max_epochs}
        self.name = study_name(self.part, space, {"training": found.directory.name, "sweep": how})
        self.folder = Path(cfg.sweeps) / self.part / self.name
        self.url = cfg.storage or f"sqlite:///{(self.folder / 'study.db').absolute()}"
        self.workers = cfg.workers or 1
        self.threads = cores_of_a_job(cfg.threads, cfg.executor, self.workers)
        self.executor = executor_of(cfg)
        self.cluster = cluster_of(cfg)
        self.gpus = visible_gpus(os.environ) if cfg.executor == "local" and self.workers > 1 else []
        if self.url.startswith("sqlite") and not self._on_this_machine():
            log.warning(
                "the study is an SQLite file, which processes of several machines cannot be trusted to share: set "
                "storage to a PostgreSQL database, unless the workers are on this machine"
            )

    def _on_this_machine(self) -> bool:
        """Whether all trials are known to run here."""
        own = {"ray": self.cluster["address"] is None, "slurm": self.cluster["slurm"]["system"] == "local"}
        return own.get(self.cfg.executor, True)

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
            config_yaml=self.cfg.yaml(), parent=self.cfg.tracking.parent,
        ) as parent:  # fmt: skip
            self.parent = parent
            with SweepProgress(max(total, done + lost), done, self.workers, self.space) as progress:
                self.progress = progress
                driver = SweepDriver(
                    ledger, self.words, self.directory, self._environment, self.workers, self.cfg.retries,
                    self.cfg.heartbeat_s, self._logs, self._ended,
                    TRAIN if self.cfg.executor == "local" else TRIAL_JOB,
                )  # fmt: skip
                try:
                    with self._one_cluster() if done < total or lost else nullcontext():
                        driver.run(total, progress.tick)
                finally:
                    write_table(ledger, self.folder)
            return report(ledger, parent, self.part, self.base, self.folder, self.cfg.save_as)

    def words(self, values: Mapping[str, Any]) -> list[str]:
        """The words of a trial's training."""
        said = any(w.startswith("trainer.threads=") for w in self.base)
        threads = [] if said else [f"trainer.threads={self.threads}"]
        how = ["force=false", "resume=auto", f"workers={self.threads}", *threads, f"tracking.parent={self.parent.id}"]
        return [*self._chosen(values), *how]

    def directory(self, values: Mapping[str, Any]) -> Path:
        """The folder of a trial's training."""
        return find_training(compose(TrainSettings, self._chosen(values))).directory

    def _chosen(self, values: Mapping[str, Any]) -> list[str]:
        return [*self.base, *(setting.word(values[setting.name]) for setting in self.space)]

    @property
    def _logs(self) -> Path:
        return self.folder / "logs"

    @contextmanager
    def _one_cluster(self) -> Iterator[None]:
        """With Ray one cluster for all trials, also where the first to need one would start it for itself."""
        with ExitStack() as stack:
            if isinstance(self.executor, RayCluster):
                kept = stack.enter_context(self.executor.kept(self.workers * self.threads))
                self.cluster["address"] = kept.address
            yield

    def _environment(self, number: int, slot: int) -> dict[str, str]:
        trial = for_trial(self.url, self.name, number, self.cfg.heartbeat_s, self.pruner)
        if self.cfg.executor == "local":
            return trial | gpu_of_slot(self.gpus, slot)
        log_file = log_of(self._logs, number)
        return trial | on_worker(self.cfg.executor, self.cluster, self.threads, log_file, TRAIN)

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
