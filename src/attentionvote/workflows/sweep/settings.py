"""Settings of a sweep: ``conf/sweep.yaml``, those of a training among them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from attentionvote.command.sections import SEED, no_password
from attentionvote.setting import Setting
from attentionvote.workflows.fleet.settings import RETRIES, THREADS
from attentionvote.workflows.train.settings import TrainSettings

# What a sweep and the processes of its trials agree on.
TRIAL = "ATTENTIONVOTE_TRIAL"  # variable of the environment: whose trial a training is
PRUNED_CODE = 3  # exit code of a process whose trial was pruned
PRUNED_AT = "pruned_at_epoch"  # attribute of the trial: the decision stands, whatever happens to its process


@dataclass(frozen=True)
class Sampler:
    """How values are drawn."""

    seed: Annotated[int, SEED]
    random_trials: Annotated[int, Setting("Trials drawn at random before TPE learns from them.", low=1, high=1_000_000)]


@dataclass(frozen=True)
class Pruner:
    """When a trial is ended early."""

    kind: Annotated[
        str,
        Setting(
            "median: below the median of the others at the same epoch; hyperband; none.",
            choices=("median", "hyperband", "none"),
        ),
    ]
    least_trials: Annotated[int, Setting("median: complete trials before any is pruned.", low=1, high=1_000_000)]
    least_epochs: Annotated[int, Setting("Epochs that every trial gets.", low=1, high=1_000_000)]
    reduction: Annotated[int, Setting("hyperband: of how many trials one goes on.", low=2, high=100)]


@dataclass(frozen=True)
class Search:
    """The group ``sweep``: the space that is searched, and how."""

    space: Annotated[Any, Setting("Settings with kind and low, high, log or choices, see conf/sweep/compact.yaml.")]
    sampler: Sampler
    pruner: Pruner


@dataclass(frozen=True, kw_only=True)
class SweepSettings(TrainSettings):
    """A study of trials of one training."""

    verb: ClassVar[str] = "sweep"
    sweep: Search
    trials: Annotated[int, Setting("Trials that the study shall have in all.", low=1, high=1_000_000)]
    threads: Annotated[int | None, THREADS]
    storage: Annotated[
        str | None,
        Setting(
            "Database of the study as an SQLAlchemy URI; null = an SQLite file in the study's folder.",
            problem=no_password("set PGPASSWORD"),
        ),
    ]
    save_as: Annotated[str | None, Setting("Write the best trial as conf/experiment/NAME.yaml too.")]
    sweeps: Annotated[str, Setting("Where studies lie: tables, figures, logs and the best settings.")]
    retries: Annotated[int, RETRIES]
    heartbeat_s: Annotated[int, Setting("Seconds between signs of life of a running sweep.", low=1, high=3600)]
