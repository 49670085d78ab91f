"""Trials through the executors as they really are: Ray and submitit take a stand-in for a training to their workers."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from attentionvote.execution import RayCluster
from attentionvote.execution.job_executors import WorkerJobs
from attentionvote.workflows.sweep.driver import SweepDriver
from attentionvote.workflows.sweep.space import Setting
from attentionvote.workflows.sweep.study import Ledger, open_study

# Stands for a training: notes its start with its process, its parent and a variable; does what the test says of it.
JOB = """
import json, os, signal, sys, time
from pathlib import Path
from attentionvote.execution.job_process import join_starter, report_failure
starter = os.getppid()
join_starter()
number = json.loads(os.environ["ATTENTIONVOTE_TRIAL"])["number"]
folder, x = Path(sys.argv[1]), float(sys.argv[2])
with (folder / "notes").open("a") as file:
    file.write(f"{number} {os.getpid()} {starter} {x} {os.environ.get('PGPASSWORD')}\\n")
times = sum(line.split()[0] == str(number) for line in (folder / "notes").read_text().splitlines())
does = json.loads((folder / "does.json").read_text()).get(str(number), "")
print("epoch 1", file=sys.stderr)
if does == "wait": time.sleep(120)
if does == "crash once" and times == 1: os.kill(os.getpid(), signal.SIGKILL)
if does == "end its worker once" and times == 1: os.kill(starter, signal.SIGKILL); time.sleep(60)
if does == "fail": report_failure("the cloud must be finite, got 3 NaN"); sys.exit(1)
if does == "prune": sys.exit(3)
print(json.dumps({"val_ap": x}))
"""
# A sweep in a process of its own, with its own cluster of this machine; to be killed.
SWEEP = f"""
import sys
sys.path[:0] = [{str(Path(__file__).parent)!r}]
from test_workers import sweep
from pathlib import Path
try: sweep(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
except KeyboardInterrupt: sys.exit(130)
"""


def sweep(folder: Path, executor: str, total: int) -> Ledger:
    """Bring the study in the folder to its total, two trials at a time."""
    stored = open_study(f"sqlite:///{folder}/study.db", "s")
    ledger = Ledger(stored, [Setting("x", "float", 0.0, 1.0)], seed=0, random_trials=2, folder=folder, heartbeat_s=1)
    (folder / "job.py").write_text(JOB, encoding="utf-8")
    cluster: dict[str, Any] = {"gpus": 0, "slurm": {"folder": str(folder / "slurm"), "system": "local", "poll_s": 0.1}}
    with ExitStack() as stack:
        if executor == "ray":
            cluster["address"] = stack.enter_context(RayCluster().shared(2)).address
        SweepDriver(
            ledger,
            WorkerJobs(folder / "job.py", executor, cluster, threads=1),
            words=lambda values: [str(folder), str(values["x"])],
            directory=lambda values: folder / f"training-{values['x']:.6f}",
            environment=lambda number, _: {"ATTENTIONVOTE_TRIAL": json.dumps({"number": number})},
            workers=2,
            retries=1,
            logs=folder / "logs",
            ended=str,
        ).run(total, lambda: None)
    return ledger


@pytest.fixture
def does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[dict[int, str]], None]:
    """Says what the trials of these numbers do."""
    monkeypatch.setenv("RAY_AUTH_TOKEN", uuid.uuid4().hex)  # else one is written at home
    monkeypatch.setenv("PGPASSWORD", "secret")

    def say(what: dict[int, str]) -> None:
        (tmp_path / "does.json").write_text(json.dumps(what))

    return say


Does = Callable[[dict[int, str]], None]


def notes(folder: Path) -> list[list[str]]:
    path = folder / "notes"
    return [line.split() for line in path.read_text().splitlines()] if path.exists() else []


def runs(pid: str) -> bool:
    """Whether a process does anything: one whose end nobody has asked for does not."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_text() != ""
    except OSError:
        return False


def until(ready: Callable[[], bool], process: subprocess.Popen[str] | None = None, within_s: float = 240) -> None:
    deadline = time.monotonic() + within_s
    while not ready():
        if process is not None and process.poll() is not None:
            pytest.fail(f"it ended: {process.communicate()}")
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[[str, int], subprocess.Popen[str]]]:
    """Starts a sweep in a process of its own, with this executor and this total."""
    begun: list[subprocess.Popen[str]] = []

    def starting(executor: str, total: int) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", SWEEP, str(tmp_path), executor, str(total)]
        begun.append(subprocess.Popen(command, text=True, stderr=-1))
        return begun[-1]

    yield starting
    for process in begun:
        process.kill()
        process.wait()


Start = Callable[[str, int], subprocess.Popen[str]]


def states_of(folder: Path) -> list[str]:
    """The states of the trials as another process sees them."""
    return [trial.state.name for trial in open_study(f"sqlite:///{folder}/study.db", "s").study.trials]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_on_ray_every_end_comes_back_and_a_killed_sweep_goes_on(tmp_path: Path, does: Does, start: Start) -> None:
    does({0: "prune", 1: "end its worker once", 2: "wait", 3: "crash once"})
    process = start("ray", 4)
    until(lambda: (tmp_path / "logs" / "trial_003.log").exists(), process)
    until(lambda: states_of(tmp_path) == ["PRUNED", "COMPLETE", "RUNNING", "COMPLETE"], process)
    process.kill()
    process.communicate()
    until(lambda: not any(runs(note[1]) for note in notes(tmp_path)), within_s=60)  # no training outlives the sweep
    does({4: "fail"})
    process = start("ray", 5)
    _, err = process.communicate(timeout=240)
    assert process.returncode == 0, err
    ledger = Ledger(open_study(f"sqlite:///{tmp_path}/study.db", "s"), [], 0, 2, tmp_path, 1)
    assert [trial.state.name for trial in ledger.trials] == ["PRUNED", "COMPLETE", "COMPLETE", "COMPLETE", "FAIL"]
    assert ledger.trials[4].user_attrs["reason"] == "the cloud must be finite, got 3 NaN"
    assert [trial.user_attrs.get("crashes", 0) for trial in ledger.trials] == [0, 1, 0, 1, 0]
    numbers = sorted(note[0] for note in notes(tmp_path))
    assert numbers == ["0", "1", "1", "2", "2", "3", "3", "4"]
    assert len({(note[0], note[3]) for note in notes(tmp_path)}) == 5  # a number has one set of parameters
    assert {note[4] for note in notes(tmp_path)} == {"secret"}
    assert all("epoch 1" in (tmp_path / "logs" / f"trial_{n:03d}.log").read_text() for n in range(5))


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_through_submitted_jobs_and_no_training_outlives_what_waits_for_it(
    tmp_path: Path, does: Does, start: Start
) -> None:
    does({0: "wait", 1: "crash once"})
    process = start("slurm", 2)
    until(lambda: states_of(tmp_path)[1:] == ["COMPLETE"], process)
    until(lambda: "0" in {note[0] for note in notes(tmp_path)}, process)
    process.kill()
    process.communicate()
    # SLURM leaves the job of a killed driver: it sees that its claim is gone.
    until(lambda: not any(runs(note[1]) for note in notes(tmp_path)), within_s=60)
    does({2: "prune"})
    ledger = sweep(tmp_path, "slurm", 3)
    assert [trial.state.name for trial in ledger.trials] == ["COMPLETE", "COMPLETE", "PRUNED"]
    assert sorted(note[0] for note in notes(tmp_path)) == ["0", "0", "1", "1", "2"]


@pytest.mark.slow
def test_ctrl_c_ends_the_training_on_its_worker(tmp_path: Path, does: Does, start: Start) -> None:
    does({0: "wait"})
    process = start("slurm", 1)
    until(lambda: len(notes(tmp_path)) == 1, process)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    until(lambda: not runs(notes(tmp_path)[0][1]), within_s=60)
    assert states_of(tmp_path) == ["RUNNING"]
