"""The study behind a sweep: persistent, the same after every interruption, one process at it at a time.

Every trial has its own seed, made of the sweep's seed and the trial's number, so that an interrupted study draws what
an uninterrupted one would have drawn; a seeded sampler of Optuna's alone would draw its first trials again. A trial
whose process died is taken up under its own number with its own parameters, so none is counted twice.
"""

from __future__ import annotations

import hashlib
import json
import platform
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import optuna
from optuna.pruners import BasePruner, HyperbandPruner, MedianPruner, NopPruner
from optuna.samplers import TPESampler
from optuna.storages import RDBStorage
from optuna.trial import FrozenTrial, Trial, TrialState

from attentionvote.workflows.sweep.space import Setting

# Attributes of a trial: where the sweep runs that is at it, how often its process died.
OWNER, CRASHES = "owner", "crashes"


def open_study(url: str, name: str, heartbeat_s: int, pruner: BasePruner | None = None) -> optuna.Study:
    """Open a study, created when new; larger values are better.

    Args:
        url: an SQLAlchemy URI.
        name: of the study.
        heartbeat_s: seconds between signs of life; without any for three of them, a trial counts as lost.
        pruner: asked by trials.

    Raises:
        ValueError: with one sentence, when the database cannot be used.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sqlite = url.startswith("sqlite")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the heartbeat is called experimental; SQLAlchemy deprecates its own
        try:
            storage = RDBStorage(
                url,
                # Several processes write to one file: each waits for the others.
                engine_kwargs={"connect_args": {"timeout": 60}} if sqlite else {"pool_pre_ping": True},
                heartbeat_interval=heartbeat_s,
                grace_period=3 * heartbeat_s,
            )
            return optuna.create_study(
                storage=storage, study_name=name, direction="maximize", pruner=pruner, load_if_exists=True
            )
        except Exception as error:  # SQLAlchemy's, the driver's, Optuna's
            reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
            raise ValueError(
                "storage must be the SQLAlchemy URI of a database that answers, such as sqlite:///study.db; got "
                f"{without_password(url)}: {reason}"
            ) from error


def without_password(url: str) -> str:
    """A database URI that may be shown."""
    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import ArgumentError

    try:
        return make_url(url).render_as_string(hide_password=True)
    except ArgumentError:
        return url.rpartition("@")[2]


def make_pruner(
    kind: str, least_trials: int, least_epochs: int, reduction: int, validate_every: int, max_epochs: int
) -> BasePruner:
    """The pruner of a configuration; its steps are epochs."""
    if kind == "median":
        return MedianPruner(least_trials, n_warmup_steps=least_epochs, interval_steps=validate_every)
    if kind == "hyperband":
        return HyperbandPruner(max(1, min(least_epochs, max_epochs)), max_epochs, reduction)
    return NopPruner()


class Ledger:
    """What has been done in a study, and what is to be done; a process that holds the study's folder writes it.

    Args:
        study: see :func:`open_study`.
        space: the settings that are searched.
        seed: of all draws.
        random_trials: trials drawn at random before the sampler learns.
        folder: of the study on this machine; whoever holds its lock owns the trials that were started from it.
    """

    def __init__(
        self, study: optuna.Study, space: Sequence[Setting], seed: int, random_trials: int, folder: Path
    ) -> None:
        self.study, self.space, self.seed, self.random_trials = study, list(space), seed, random_trials
        self.owner = f"{platform.node()}:{folder.absolute()}"

    @property
    def trials(self) -> list[FrozenTrial]:
        """Every trial, by number; the numbers have no gaps."""
        return self.study.get_trials(deepcopy=False)

    def count(self, state: TrialState) -> int:
        """How many trials are in a state."""
        return sum(trial.state == state for trial in self.trials)

    @property
    def best(self) -> FrozenTrial | None:
        """The complete trial with the best value, the first of equals."""
        complete = [trial for trial in self.trials if trial.state == TrialState.COMPLETE]
        return max(complete, key=lambda trial: (trial.value, -trial.number), default=None)

    def lost(self) -> list[FrozenTrial]:
        """The trials that were begun and that nobody is at any more.

        Raises:
            ValueError: when a sweep in another place is at this study.
        """
        begun = [trial for trial in self.trials if trial.state == TrialState.RUNNING]
        storage: Any = self.study._storage
        silent = set(storage._get_stale_trial_ids(self.study._study_id))
        for trial in begun:
            other = trial.user_attrs.get(OWNER, self.owner)
            # Ours are lost for certain: we hold the folder's lock. Others' are when they give no sign of life.
            if other != self.owner and trial._trial_id not in silent:
                raise ValueError(
                    f"the study {self.study.study_name} must have one sweep at a time, but the one at {other} gave a "
                    f"sign of life less than {3 * storage.get_heartbeat_interval()} s ago: wait for it, or end it"
                )
        return begun

    def begin(self, lost: FrozenTrial | None = None) -> tuple[Trial, dict[str, Any]]:
        """Begin a new trial, or a lost one again; the trial and its values by setting."""
        number = len(self.trials) if lost is None else lost.number
        self.study.sampler = self._sampler(number)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # signs of life are called experimental, and given by us
            trial = self.study.ask() if lost is None else Trial(self.study, lost._trial_id)
            trial.set_user_attr(OWNER, self.owner)
            self.beat([trial])
            return trial, {setting.name: setting.suggest(trial) for setting in self.space}

    def beat(self, trials: Sequence[Trial]) -> None:
        """Give a sign of life for trials."""
        storage: Any = self.study._storage
        for trial in trials:
            storage.record_heartbeat(trial._trial_id)

    def crashed(self, trial: Trial) -> int:
        """Note that the process of a trial died; how often by now."""
        times = int(trial.user_attrs.get(CRASHES, 0)) + 1
        trial.set_user_attr(CRASHES, times)
        return times

    def end(self, trial: Trial, state: TrialState, value: float | None = None, **about: Any) -> None:
        """Write how a trial ended, and what there is to say about it."""
        for name, text in about.items():
            trial.set_user_attr(name, text)
        self.study.tell(trial.number, value, state)

    def _sampler(self, number: int) -> TPESampler:
        digest = hashlib.sha256(f"{self.seed}/{number}".encode()).digest()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            # Trials that run side by side keep away from each other.
            return TPESampler(
                n_startup_trials=self.random_trials, seed=int.from_bytes(digest[:4], "little"), constant_liar=True
            )


def study_name(part: str, space: str, contents: Mapping[str, Any]) -> str:
    """``PART-SPACE-DIGEST``: another base, space or way to search is another study."""
    digest = hashlib.sha256(json.dumps(contents, sort_keys=True).encode()).hexdigest()
    return f"{part}-{space}-{digest[:12]}"
