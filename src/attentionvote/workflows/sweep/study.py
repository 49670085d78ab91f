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
from dataclasses import dataclass
from datetime import UTC
from pathlib import Path
from typing import Any

import optuna
import sqlalchemy
from optuna.pruners import BasePruner, HyperbandPruner, MedianPruner, NopPruner
from optuna.samplers import TPESampler
from optuna.storages import RDBStorage
from optuna.trial import FrozenTrial, Trial, TrialState

from attentionvote.workflows.sweep.space import Setting

CRASHES = "crashes"  # attribute of a trial: how often its process died
_LEASE = "sweep"  # attribute of a study: where the sweep is that works at it, and when it gave its last sign of life
_SILENT = 3  # heartbeats without a sign of life after which a sweep counts as dead


@dataclass(frozen=True)
class StoredStudy:
    """A study and the database that it lies in."""

    study: optuna.Study
    storage: RDBStorage

    def trial(self, number: int) -> Trial:
        """A trial that was begun, to report to or to go on with."""
        study_id = self.storage.get_study_id_from_name(self.study.study_name)
        return Trial(self.study, self.storage.get_trial_id_from_study_id_trial_number(study_id, number))

    def owner(self) -> str | None:
        """Where the sweep is that has the study; None before the first."""
        owner: str | None = self.study.user_attrs.get(_LEASE, {}).get("owner")
        return owner

    def silence_s(self) -> float:
        """How long its owner has given no sign of life."""
        return self._now_s() - float(self.study.user_attrs[_LEASE]["seen_s"])

    def lease(self, owner: str) -> None:
        """Give a sign of life."""
        self.study.set_user_attr(_LEASE, {"owner": owner, "seen_s": self._now_s()})

    def _now_s(self) -> float:
        # The database's clock: those of the machines need not agree.
        with self.storage.engine.connect() as connection:
            now = connection.execute(sqlalchemy.select(sqlalchemy.func.current_timestamp())).scalar_one()
        seconds: float = (now if now.tzinfo else now.replace(tzinfo=UTC)).timestamp()
        return seconds


def open_study(url: str, name: str, pruner: BasePruner | None = None) -> StoredStudy:
    """Open a study, created when new; larger values are better.

    Args:
        url: an SQLAlchemy URI.
        name: of the study.
        pruner: asked by trials.

    Raises:
        ValueError: with one sentence, when the database cannot be used.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sqlite = url.startswith("sqlite")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # SQLAlchemy deprecates its own
        try:
            storage = RDBStorage(
                url,
                # Several processes write to one file: each waits for the others.
                engine_kwargs={"connect_args": {"timeout": 60}} if sqlite else {"pool_pre_ping": True},
            )
            study = optuna.create_study(
                storage=storage, study_name=name, direction="maximize", pruner=pruner, load_if_exists=True
            )
            return StoredStudy(study, storage)
        except Exception as error:  # SQLAlchemy's, the driver's, Optuna's
            reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
            raise ValueError(
                "storage must be the SQLAlchemy URI of a database that answers, such as sqlite:///study.db; got "
                f"{without_password(url)}: {reason}"
            ) from error


def without_password(url: str) -> str:
    """A database URI that may be shown."""
    try:
        return sqlalchemy.make_url(url).render_as_string(hide_password=True)
    except sqlalchemy.exc.ArgumentError:
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
        stored: see :func:`open_study`.
        space: the settings that are searched.
        seed: of all draws.
        random_trials: trials drawn at random before the sampler learns.
        folder: of the study on this machine; whoever holds its lock owns the trials that were started from it.
        heartbeat_s: seconds between signs of life.
    """

    def __init__(
        self,
        stored: StoredStudy,
        space: Sequence[Setting],
        seed: int,
        random_trials: int,
        folder: Path,
        heartbeat_s: int,
    ) -> None:
        self.stored, self.study, self.space = stored, stored.study, list(space)
        self.seed, self.random_trials, self.heartbeat_s = seed, random_trials, heartbeat_s
        self.owner = f"{platform.node()}:{folder.absolute()}"
        self._leased = False

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
            ValueError: see :meth:`check`.
        """
        self.check()
        return [trial for trial in self.trials if trial.state == TrialState.RUNNING]

    def check(self) -> None:
        """Refuse to work at a study that another sweep has; before whatever is written.

        Raises:
            ValueError: when a sweep in another place is at this study, or has taken it over from us.
        """
        owner = self.stored.owner()
        # What we have not leased is ours all the same when the lease is our folder's: we hold its lock.
        if owner is None or owner == self.owner:
            return
        if self._leased:  # we were stopped for so long that we counted as dead
            raise ValueError(
                f"the sweep stops, because it gave no sign of life for {_SILENT * self.heartbeat_s} s and the one at "
                f"{owner} took the study {self.study.study_name} over: leave it to that one, or end that one and start "
                "the same command here again"
            )
        least_s = _SILENT * self.heartbeat_s
        if self.count(TrialState.RUNNING) and self.stored.silence_s() < least_s:
            raise ValueError(
                f"the study {self.study.study_name} must have one sweep at a time, but the one at {owner} gave a "
                f"sign of life less than {least_s} s ago: wait for it, or end it"
            )

    def beat(self) -> None:
        """Give a sign of life.

        Raises:
            ValueError: see :meth:`check`.
        """
        self.check()
        self.stored.lease(self.owner)
        self._leased = True

    def begin(self, lost: FrozenTrial | None = None) -> tuple[Trial, dict[str, Any]]:
        """Begin a new trial, or a lost one again; the trial and its values by setting."""
        self.beat()
        number = len(self.trials) if lost is None else lost.number
        self.study.sampler = self._sampler(number)
        trial = self.study.ask() if lost is None else self.stored.trial(number)
        return trial, {setting.name: setting.suggest(trial) for setting in self.space}

    def note(self, trial: Trial, **about: Any) -> None:
        """Write what there is to say about a trial."""
        self.check()
        for name, text in about.items():
            trial.set_user_attr(name, text)

    def crashed(self, trial: Trial) -> int:
        """Note that the process of a trial died; how often by now."""
        times = int(trial.user_attrs.get(CRASHES, 0)) + 1
        self.note(trial, **{CRASHES: times})
        return times

    def end(self, trial: Trial, state: TrialState, value: float | None = None, **about: Any) -> None:
        """Write how a trial ended, and what there is to say about it."""
        self.note(trial, **about)
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
