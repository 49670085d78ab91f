"""One sweep from its configuration to its report: the study, its run in MLflow, its trials, its files."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from optuna.trial import FrozenTrial, TrialState

from attentionvote.command.conf_folder import SCRIPTS
from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.command.executors import cluster_of, cores_of_a_job, executor_of
from attentionvote.execution import RayCluster
from attentionvote.execution.hardware import gpu_of_slot, visible_gpus
from attentionvote.execution.job_executors import JobExecutor, LocalJobs, WorkerJobs
from attentionvote.workflows.sweep.driver import SweepDriver
from attentionvote.workflows.sweep.ending import report
from attentionvote.workflows.sweep.progress import SweepProgress
from attentionvote.workflows.sweep.report import experiment_text, run_of, write_table
from attentionvote.workflows.sweep.settings import TRIAL, SweepSettings
from attentionvote.workflows.sweep.space import parse_space
from attentionvote.workflows.sweep.study import Ledger, make_pruner, open_study, study_name
from attentionvote.workflows.train.job import find_training
from attentionvote.workflows.train.settings import TrainSettings

TRAIN = SCRIPTS / "train.py"
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
        # Of another machine is known what it was asked for; a GPU decides the precision, and so which training it is.
        self.gpu = None if cfg.executor == "local" else cfg.cluster.gpus > 0
        train_folder = find_training(training, self.gpu).directory
        t = training.trainer
        if t.max_epochs < t.validate_every:
            raise ConfigurationError(
                f"trainer.max_epochs must be at least trainer.validate_every ({t.validate_every}), or no trial has a "
                f"val/ap; got {t.max_epochs}"
            )
        search = cfg.composed["sweep"]
        self.space = parse_space(search["space"], training)
        experiment_text(self.base, {}, "")  # what cannot be written as an experiment is said now
        self.pruner = {**search["pruner"], "validate_every": t.validate_every, "max_epochs": t.max_epochs}
        self.name = study_name(self.part, space, {"training": train_folder.name, "sweep": search})
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
        local = {"ray": self.cluster["address"] is None, "slurm": self.cluster["slurm"]["system"] == "local"}
        return local.get(self.cfg.executor, True)

    def open(self) -> None:
        """Open the study.

        Raises:
            ValueError: when its database cannot be used, or another sweep is at it.
        """
        stored = open_study(self.url, self.name, make_pruner(**self.pruner))
        sampler = self.cfg.sweep.sampler
        self.ledger = Ledger(stored, self.space, sampler.seed, sampler.random_trials, self.folder, self.cfg.heartbeat_s)
        self.ledger.check()

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
                try:
                    if done < total or lost:
                        with self._jobs() as jobs:
                            SweepDriver(
                                ledger, jobs, self.words, self.directory, self._environment, self.workers,
                                self.cfg.retries, self.folder / "logs", self._ended,
                            ).run(total, progress.tick)  # fmt: skip
                finally:
                    write_table(ledger, self.folder)
            return report(ledger, parent, self.part, self.base, self.folder, self.cfg.save_as)

    def words(self, values: Mapping[str, Any]) -> list[str]:
        """The words of a trial's training."""
        shared = ["force=false", "resume=auto", f"workers={self.threads}", f"tracking.parent={self.parent.id}"]
        if not any(word.startswith("trainer.threads=") for word in self.base):
            shared.append(f"trainer.threads={self.threads}")
        return [*self._varied(values), *shared]

    def directory(self, values: Mapping[str, Any]) -> Path:
        """The folder of a trial's training."""
        return find_training(compose(TrainSettings, self._varied(values)), self.gpu).directory

    def _varied(self, values: Mapping[str, Any]) -> list[str]:
        return [*self.base, *(setting.word(values[setting.name]) for setting in self.space)]

    @contextmanager
    def _jobs(self) -> Iterator[JobExecutor]:
        """What starts trainings; with Ray in one cluster for all, also where the first would start it for itself."""
        if isinstance(self.executor, RayCluster):
            with self.executor.shared(self.workers * self.threads) as shared:
                yield WorkerJobs(TRAIN, "ray", {**self.cluster, "address": shared.address}, self.threads)
        elif self.cfg.executor == "local":
            yield LocalJobs(TRAIN)
        else:
            yield WorkerJobs(TRAIN, self.cfg.executor, self.cluster, self.threads)

    def _environment(self, number: int, slot: int) -> dict[str, str]:
        about = {"url": self.url, "study": self.name, "number": number, "owner": self.ledger.owner}
        return {TRIAL: json.dumps({**about, "pruner": self.pruner})} | gpu_of_slot(self.gpus, slot)

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
