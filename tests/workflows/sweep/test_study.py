"""The study: what it draws does not depend on interruptions, lost trials go on, one sweep at a time."""

from __future__ import annotations

import math
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import optuna
import pytest
from optuna.storages import RDBStorage
from optuna.trial import TrialState

from attentionvote.workflows.sweep.space import Setting
from attentionvote.workflows.sweep.study import Ledger, make_pruner, open_study, study_name
from attentionvote.workflows.sweep.trial_report import TrialReport

SPACE = [
    Setting("x", "float", 0.0, 1.0),
    Setting("y", "float", 1e-3, 1.0, log=True),
    Setting("z", "categorical", choices=("a", "b")),
]


def ledger(folder: Path, name: str = "s", place: str = "here", heartbeat_s: int = 60) -> Ledger:
    stored = open_study(f"sqlite:///{folder / 'study.db'}", name)
    return Ledger(stored, SPACE, seed=1, random_trials=2, folder=folder / place, heartbeat_s=heartbeat_s)


def score(values: dict) -> float:
    return values["x"] - abs(math.log10(values["y"]) + 1)


def test_an_interrupted_study_draws_what_a_whole_one_draws(tmp_path: Path) -> None:
    whole = ledger(tmp_path, "whole")
    for _ in range(4):
        trial, values = whole.begin()
        whole.end(trial, TrialState.COMPLETE, score(values))
    for call in range(4):  # a process each; every second one is killed within its trial and begins it again
        if call % 2:
            ledger(tmp_path, "torn").begin()
        torn = ledger(tmp_path, "torn")
        lost = torn.lost()
        assert len(lost) == call % 2
        trial, values = torn.begin(*lost)
        torn.end(trial, TrialState.COMPLETE, score(values))
    assert [t.params for t in torn.trials] == [t.params for t in whole.trials]
    assert [t.number for t in torn.trials] == list(range(4))
    assert len({t.params["x"] for t in whole.trials}) == 4  # and nothing is drawn twice
    assert [t.value for t in torn.trials] == [t.value for t in whole.trials]
    assert torn.best is not None
    assert torn.best.value == max(t.value for t in torn.trials)


def test_a_lost_trial_keeps_its_number_parameters_and_reports(tmp_path: Path) -> None:
    trial, values = ledger(tmp_path).begin()
    trial.report(0.25, 4)
    again = ledger(tmp_path)
    (lost,) = again.lost()
    trial, same = again.begin(lost)
    assert (trial.number, same) == (0, values)
    assert again.trials[0].intermediate_values == {4: 0.25}
    assert (again.crashed(trial), again.crashed(trial)) == (1, 2)
    again.end(trial, TrialState.FAIL, reason="why")
    assert (again.trials[0].state, again.trials[0].user_attrs["reason"]) == (TrialState.FAIL, "why")
    assert (again.best, again.lost(), len(again.trials)) == (None, [], 1)


@pytest.mark.filterwarnings("ignore")  # heartbeats of Optuna's are experimental
def test_a_study_without_a_lease_goes_on(tmp_path: Path) -> None:
    # As sweeps wrote them before: whose a trial is was an attribute of it, its signs of life were Optuna's.
    url = f"sqlite:///{tmp_path / 'study.db'}"
    storage = RDBStorage(url, heartbeat_interval=60, grace_period=180)
    study = optuna.create_study(storage=storage, study_name="s", direction="maximize")
    for _ in range(2):
        begun = study.ask()
        for setting in SPACE:
            setting.suggest(begun)
        begun.set_user_attr("owner", "elsewhere:/sweeps/s")
    study.tell(0, 0.5)
    again = ledger(tmp_path)
    (lost,) = again.lost()
    trial, values = again.begin(lost)
    again.end(trial, TrialState.COMPLETE, score(values))
    assert [t.params for t in again.trials] == [t.params for t in study.trials]
    assert again.count(TrialState.COMPLETE) == 2
    storage.engine.dispose()


def test_one_sweep_at_a_time_from_several_places(tmp_path: Path) -> None:
    first = ledger(tmp_path, heartbeat_s=1)
    trial, values = first.begin()
    second = ledger(tmp_path, place="elsewhere", heartbeat_s=1)
    with pytest.raises(ValueError, match=r"must have one sweep at a time, but the one at .*/here gave a sign of life"):
        second.lost()
    deadline = time.monotonic() + 30
    while True:  # no sign of life any more
        try:
            (lost,) = second.lost()
            break
        except ValueError:
            assert time.monotonic() < deadline
            time.sleep(0.2)
    assert second.begin(lost)[1] == values
    with pytest.raises(ValueError, match=r"/elsewhere gave a sign of life"):
        ledger(tmp_path, heartbeat_s=1).lost()
    with pytest.raises(ValueError, match=r"gave no sign of life for 3 s and the one at .*/elsewhere took the study s"):
        first.end(trial, TrialState.FAIL)
    assert [t.state for t in second.trials] == [TrialState.RUNNING]


def test_a_training_whose_trial_was_taken_over_reports_nothing_and_ends(tmp_path: Path) -> None:
    here = ledger(tmp_path)
    here.begin()
    report = TrialReport(here.stored, 0, here.owner)
    validated: Any = SimpleNamespace(
        sanity_checking=False, callback_metrics={"val/ap": 0.5}, current_epoch=0, max_epochs=4
    )
    report.on_validation_end(validated, validated)
    here.stored.lease("elsewhere:/sweeps/s")
    validated.current_epoch = 1
    with pytest.raises(ValueError, match="because the sweep at elsewhere:/sweeps/s took its trial 0 over"):
        report.on_validation_end(validated, validated)
    assert here.trials[0].intermediate_values == {1: 0.5}


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("postgresql://me:secret@127.0.0.1:1/x", r"got postgresql://me:\*\*\*@127.0.0.1:1/x: .*"),
        ("nonsense", "got nonsense: "),
        ("sqlite:////proc/nowhere/x.db", "got sqlite:////proc/nowhere/x.db: .*unable to open"),
    ],
)
def test_a_database_that_does_not_answer_is_one_sentence_without_the_password(url: str, shown: str) -> None:
    with pytest.raises(
        ValueError, match=f"storage must be the SQLAlchemy URI of a database that answers.*{shown}"
    ) as error:
        open_study(url, "s")
    assert "\n" not in str(error.value)
    assert "secret" not in str(error.value)


@pytest.mark.parametrize("kind", ["median", "hyperband", "none"])
def test_the_pruner_ends_a_bad_trial_after_its_least_epochs(kind: str, tmp_path: Path) -> None:
    pruner = make_pruner(kind, least_trials=2, least_epochs=4, reduction=3, validate_every=2, max_epochs=12)
    study = open_study(f"sqlite:///{tmp_path}/study.db", kind, pruner).study

    def train(value: float) -> int:
        """The epoch that a trial of this score ends at."""
        trial = study.ask()
        for epoch in range(2, 13, 2):
            trial.report(value, epoch)
            if epoch < 12 and trial.should_prune():
                study.tell(trial.number, state=TrialState.PRUNED)
                return epoch
        study.tell(trial.number, value)
        return 12

    for index in range(4):
        train(0.8 + 0.01 * index)
    ended = {train(0.1) for _ in range(5)}  # hyperband gives some trials all their epochs at once
    assert min(ended) == {"median": 4, "hyperband": 4, "none": 12}[kind]
    assert kind != "median" or ended == {4}


def test_the_name_says_part_space_and_settings() -> None:
    assert study_name("gear", "compact", {"a": 1}) == study_name("gear", "compact", {"a": 1})
    assert study_name("gear", "compact", {"a": 1}) != study_name("gear", "compact", {"a": 2})
    assert study_name("gear", "compact", {"a": 1}).startswith("gear-compact-")


def test_a_study_in_postgresql_stands_a_lost_trial_and_two_places(postgresql: Any, tmp_path: Path) -> None:
    name = postgresql.create()

    def opened(place: str) -> Ledger:
        stored = open_study(postgresql.uri(name), "s", make_pruner("median", 1, 1, 3, 1, 9))
        return Ledger(stored, SPACE, seed=1, random_trials=2, folder=tmp_path / place, heartbeat_s=60)

    first = opened("here")
    trial, values = first.begin()
    trial.report(0.25, 4)
    with pytest.raises(ValueError, match=r"/here gave a sign of life less than 180 s ago"):
        opened("elsewhere").lost()
    again = opened("here")
    trial, same = again.begin(*again.lost())
    again.end(trial, TrialState.COMPLETE, 0.5)
    assert (same, again.trials[0].intermediate_values) == (values, {4: 0.25})
    assert again.best is not None
    for used in (first, again):
        used.stored.storage.remove_session()
        used.stored.storage.engine.dispose()
    postgresql.drop(name)
