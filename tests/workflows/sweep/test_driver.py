"""The driver with real processes and a real SQLite study: side by side, crashes, kill -9, Ctrl-C, failures."""

from __future__ import annotations

import fcntl
import json
import os
import re
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any

import pytest
from optuna.trial import TrialState

from attentionvote.execution.job_executors import LocalJobs
from attentionvote.workflows.sweep.driver import SweepDriver
from attentionvote.workflows.sweep.space import Setting
from attentionvote.workflows.sweep.study import Ledger, open_study

SPACE = [Setting("x", "float", 0.0, 1.0)]
# Stands for a training: notes its start and end, and does what the test says of its number.
JOB = """
import json, os, signal, sys, time
from pathlib import Path
from attentionvote.execution.job_process import join_starter, report_failure
join_starter()
number = json.loads(os.environ["ATTENTIONVOTE_TRIAL"])["number"]
folder, x = Path(sys.argv[1]), float(sys.argv[2])
def note(what):
    with (folder / "notes").open("a") as file: file.write(f"{what} {number} {os.getpid()} {x}\\n")
note("start")
times = (folder / "notes").read_text().count(f"start {number} ")
does = json.loads((folder / "does.json").read_text()).get(str(number), "")
try:
    if does == "wait": time.sleep(60)
    time.sleep(0.2)
except KeyboardInterrupt:
    note("interrupted"); sys.exit(130)
if does == "crash" or (does == "crash once" and times == 1): os.kill(os.getpid(), signal.SIGKILL)
if does == "fail": report_failure(f"the cloud must be finite, got {os.getpid()} NaN"); sys.exit(1)
if does == "prune": sys.exit(3)
note("end")
print(json.dumps({"val_ap": None if does == "no score" else x, "metrics": {"ap_10": 0.5}}))
"""
# A sweep in a process of its own, to be killed.
SWEEP = f"""
import sys
sys.path[:0] = [{str(Path(__file__).parent)!r}]
from test_driver import driver
from pathlib import Path
try: driver(Path(sys.argv[1]), int(sys.argv[3]), heartbeat_s=1)[1].run(int(sys.argv[2]), lambda: None)
except KeyboardInterrupt: sys.exit(130)
"""


def driver(folder: Path, workers: int = 1, place: str = "", heartbeat_s: int = 60) -> tuple[Ledger, SweepDriver]:
    """A study in a folder and what drives it, from this place."""
    stored = open_study(f"sqlite:///{folder}/study.db", "s")
    ledger = Ledger(stored, SPACE, seed=0, random_trials=2, folder=folder / place, heartbeat_s=heartbeat_s)
    (folder / "job.py").write_text(JOB, encoding="utf-8")
    return ledger, SweepDriver(
        ledger,
        LocalJobs(folder / "job.py"),
        words=lambda values: [str(folder), str(values["x"])],
        directory=lambda values: folder / f"training-{values['x']:.6f}",
        environment=lambda number, _: {"ATTENTIONVOTE_TRIAL": json.dumps({"number": number})},
        workers=workers,
        retries=1,
        logs=folder / "logs",
        ended=lambda trial: (folder / f"ended-{trial.number}").touch(exist_ok=False),
    )


@pytest.fixture
def does(tmp_path: Path) -> Callable[[dict[int, str]], None]:
    """Says what the trials of these numbers do."""

    def say(what: dict[int, str]) -> None:
        (tmp_path / "does.json").write_text(json.dumps(what))

    say({})
    return say


Does = Callable[[dict[int, str]], None]
StartSweep = Callable[[int], "subprocess.Popen[str]"]


@pytest.fixture
def start_sweep(tmp_path: Path) -> Iterator[StartSweep]:
    """Starts a sweep of so many trials, two at a time, in a process that ends with the test."""
    with ExitStack() as stack:

        def start(trials: int) -> subprocess.Popen[str]:
            words = [sys.executable, "-c", SWEEP, str(tmp_path), str(trials), "2"]
            process = stack.enter_context(subprocess.Popen(words, text=True, stderr=subprocess.PIPE))
            stack.callback(process.kill)
            return process

        yield start


def pause(process: subprocess.Popen[str], folder: Path) -> None:
    """Stop a sweep, but not while it writes: nobody else could, before it goes on."""
    for _ in range(100):
        process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED)
        with closing(sqlite3.connect(folder / "study.db", timeout=0)) as study, suppress(sqlite3.OperationalError):
            study.execute("BEGIN IMMEDIATE")
            return
        process.send_signal(signal.SIGCONT)
        time.sleep(0.01)
    raise AssertionError("the sweep writes all the time")


def notes(folder: Path) -> list[list[str]]:
    path = folder / "notes"
    return [line.split() for line in path.read_text().splitlines()] if path.exists() else []


def states(ledger: Ledger) -> list[str]:
    return [trial.state.name for trial in ledger.trials]


def command_line_of(pid: str) -> str:
    """What a process was started as; nothing when it has ended, also when nobody has asked for its exit code."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_text()
    except OSError:
        return ""


def may_run(ledger: Ledger) -> bool:
    """Whether no other sweep is at the study any more."""
    try:
        ledger.check()
    except ValueError:
        return False
    return True


def until(ready: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 60
    while not ready():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.slow
def test_every_end_of_a_trial_is_written_down_and_stops_no_other(tmp_path: Path, does: Does) -> None:
    does({0: "fail", 1: "prune", 2: "crash once", 3: "crash", 4: "no score"})
    ledger, sweep = driver(tmp_path)
    ledger.begin()[0].report(0.25, 4)  # of a process that was killed
    sweep.run(6, lambda: None)
    assert states(ledger) == ["FAIL", "PRUNED", "COMPLETE", "FAIL", "FAIL", "COMPLETE"]
    starts = [note[1] for note in notes(tmp_path) if note[0] == "start"]
    assert starts == ["0", "1", "2", "2", "3", "3", "4", "5"]
    for number in (2, 3):  # taken up with the same parameters
        assert len({note[3] for note in notes(tmp_path) if note[1] == str(number)}) == 1
    trials = ledger.trials
    assert trials[0].user_attrs["reason"].startswith("the cloud must be finite, got ")
    assert trials[3].user_attrs["reason"] == "its process was ended by SIGKILL (out of memory?)"
    assert trials[4].user_attrs["reason"].startswith("its training has no val/ap")
    assert trials[2].value == trials[2].params["x"]
    assert trials[5].user_attrs["test"] == {"ap_10": 0.5}
    assert sorted(p.name for p in tmp_path.glob("ended-*")) == [f"ended-{n}" for n in range(6)]
    assert (tmp_path / "logs" / "trial_002.log").is_file()
    # The total is reached: the same call does nothing, a larger total only what is missing.
    again = driver(tmp_path)[1]
    again.run(6, lambda: None)
    again.run(7, lambda: None)
    assert [note[1] for note in notes(tmp_path) if note[0] == "start"] == [*starts, "6"]


def test_two_at_a_time_and_never_two_at_one_training(tmp_path: Path, does: Does) -> None:
    does({})
    ledger, sweep = driver(tmp_path, workers=2)
    together = []
    sweep.run(4, lambda: together.append(len(sweep.running)))
    assert max(together) == 2
    assert states(ledger) == ["COMPLETE"] * 4
    # Somebody is at the training of the next trial: it waits.
    trial, values = Ledger(ledger.stored, SPACE, 0, 2, tmp_path, 60).begin()
    place = tmp_path / f"training-{values['x']:.6f}"
    place.mkdir(exist_ok=True)
    with (place / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        seen = []

        def free() -> None:
            seen.append(len(sweep.waiting))
            if len(seen) == 5:
                fcntl.flock(lock, fcntl.LOCK_UN)

        sweep.run(5, free)
    assert seen[:4] == [1] * 4
    assert states(ledger) == ["COMPLETE"] * 5
    assert ledger.trials[trial.number].params == values


@pytest.mark.slow
def test_killed_in_the_middle_it_goes_on_as_if_it_had_not_been(
    tmp_path: Path, does: Does, start_sweep: StartSweep
) -> None:
    whole = tmp_path / "whole"
    whole.mkdir()
    (whole / "does.json").write_text("{}")
    ledger, sweep = driver(whole)
    sweep.run(4, lambda: None)
    does({1: "wait", 2: "wait"})
    process = start_sweep(4)
    until(lambda: {"1", "2"} <= {note[1] for note in notes(tmp_path)}, process)
    process.kill()
    process.communicate()
    does({})
    torn, again = driver(tmp_path, workers=2)
    assert states(torn) == ["COMPLETE", "RUNNING", "RUNNING"]
    assert len(torn.lost()) == 2
    again.run(4, lambda: None)
    assert states(torn) == ["COMPLETE"] * 4
    assert torn.trials[0].params == ledger.trials[0].params
    started = [(note[1], note[3]) for note in notes(tmp_path) if note[0] == "start"]
    assert sorted(number for number, _ in started) == ["0", "1", "1", "2", "2", "3"]
    assert len(set(started)) == 4  # a number has one set of parameters
    for note in notes(tmp_path):  # no orphan of the killed sweep went on
        assert str(tmp_path) not in command_line_of(note[2])


def test_ctrl_c_ends_the_trials_orderly_and_they_go_on(tmp_path: Path, does: Does, start_sweep: StartSweep) -> None:
    does({0: "wait", 1: "wait"})
    process = start_sweep(3)
    until(lambda: len(notes(tmp_path)) == 2, process)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert [note[0] for note in notes(tmp_path)].count("interrupted") == 2
    does({})
    ledger, sweep = driver(tmp_path)
    sweep.run(3, lambda: None)
    assert states(ledger) == ["COMPLETE"] * 3
    assert ledger.count(TrialState.COMPLETE) == 3
    assert len(list((tmp_path / "logs").iterdir())) == 3


def test_paused_for_too_long_it_leaves_its_trials_to_the_sweep_that_took_them_over(
    tmp_path: Path, does: Does, start_sweep: StartSweep
) -> None:
    does({0: "wait", 1: "wait"})
    process = start_sweep(2)
    until(lambda: len(notes(tmp_path)) == 2, process)
    pause(process, tmp_path)
    # Awake again, it would find this trial crashed and take it up.
    os.kill(int(next(note[2] for note in notes(tmp_path) if note[1] == "1")), signal.SIGKILL)
    does({})
    ledger, sweep = driver(tmp_path, workers=2, place="elsewhere", heartbeat_s=1)
    until(lambda: may_run(ledger), process)
    errors = []

    def awake() -> None:  # while the other's trials run
        if not errors:
            process.send_signal(signal.SIGCONT)
            errors.append(process.communicate(timeout=60)[1])

    sweep.run(2, awake)
    sentence = (
        "ValueError: the sweep stops, because it gave no sign of life for 3 s and the one at [^ ]+/elsewhere took the "
        "study s over: leave it to that one, or end that one and start the same command here again"
    )
    assert re.fullmatch(sentence, errors[0].splitlines()[-1])
    assert process.returncode == 1
    assert states(ledger) == ["COMPLETE"] * 2
    assert all("crashes" not in trial.user_attrs for trial in ledger.trials)
    assert sorted(note[0] for note in notes(tmp_path)) == ["end", "end", "interrupted", *["start"] * 4]
    assert len({note[3] for note in notes(tmp_path)}) == 2  # taken over with their own parameters
    # The study is the other's as long as that one works at it; afterwards it may go on here.
    driver(tmp_path)[1].run(3, lambda: None)
    assert states(ledger) == ["COMPLETE"] * 3


def test_a_short_pause_changes_nothing(tmp_path: Path, does: Does, start_sweep: StartSweep) -> None:
    does({})
    process = start_sweep(2)
    until(lambda: len(notes(tmp_path)) > 1, process)
    pause(process, tmp_path)
    ledger = driver(tmp_path, place="elsewhere", heartbeat_s=1)[0]
    with pytest.raises(ValueError, match="must have one sweep at a time"):
        ledger.lost()
    process.send_signal(signal.SIGCONT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert states(ledger) == ["COMPLETE"] * 2


@pytest.mark.usefixtures("does")
def test_an_impossible_combination_fails_its_trial_and_no_other(tmp_path: Path) -> None:
    ledger, sweep = driver(tmp_path)
    place = sweep.directory
    seen: list[Mapping[str, Any]] = []

    def directory(values: Mapping[str, Any]) -> Path:
        seen.append(values)
        if len(seen) == 2:
            raise ValueError("model.widths must fit model.centers")
        return place(values)

    sweep.directory = directory
    sweep.run(3, lambda: None)
    assert states(ledger) == ["COMPLETE", "FAIL", "COMPLETE"]
    assert ledger.trials[1].user_attrs["reason"] == "model.widths must fit model.centers"


@pytest.mark.slow
def test_trials_that_fail_for_one_cause_are_not_used_up(tmp_path: Path, does: Does) -> None:
    does(dict.fromkeys(range(1, 9), "fail"))
    ledger, sweep = driver(tmp_path)
    message = "trials 1, 2, 3 failed in a row with the same sentence; .*gone: the cloud must be finite, got [0-9]+ NaN"
    with pytest.raises(ValueError, match=message):
        sweep.run(9, lambda: None)
    assert states(ledger) == ["COMPLETE"] + ["RUNNING"] * 3
    drawn = [trial.params for trial in ledger.trials]
    # The cause is still there: none is used up by finding that out.
    ledger, sweep = driver(tmp_path)
    with pytest.raises(ValueError, match="trials 1, 2, 3, 4, 5, 6 failed in a row"):
        sweep.run(9, lambda: None)
    assert states(ledger) == ["COMPLETE"] + ["RUNNING"] * 6
    # It is gone for all but two, whose settings it was; they stop nobody again.
    does({1: "fail", 3: "fail"})
    ledger, sweep = driver(tmp_path)
    sweep.run(9, lambda: None)
    assert states(ledger) == ["COMPLETE", "FAIL", "COMPLETE", "FAIL", *["COMPLETE"] * 5]
    assert [trial.params for trial in ledger.trials][:4] == drawn
    assert sorted(p.name for p in tmp_path.glob("ended-*")) == [f"ended-{n}" for n in range(9)]


@pytest.mark.usefixtures("does")
def test_no_two_trials_side_by_side_have_one_slot(tmp_path: Path) -> None:
    _, sweep = driver(tmp_path, workers=2)
    environment, slots, together = sweep.environment, [], []

    def noted(number: int, slot: int) -> Mapping[str, str]:
        slots.append(slot)
        return environment(number, slot)

    sweep.environment = noted
    sweep.run(3, lambda: together.append([running.slot for running in sweep.running]))
    assert set(slots) == {0, 1}
    assert all(len(set(some)) == len(some) for some in together)
