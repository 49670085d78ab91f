"""A grid as a user meets it: every job, failures at the end, exit codes, Ctrl-C and kill -9, and its runs in MLflow."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import warm_starter

from attentionvote.command.configuration import compose
from attentionvote.tracking.run_opening import start_run
from attentionvote.tracking.store import connect, resolve_store
from attentionvote.workflows.train.settings import TrainSettings

SCRIPT = '''
"""A verb that does what it is told."""
import json, os, signal, sys, time
from pathlib import Path
from attentionvote.command.entry import command, configuring
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar
from attentionvote.command.configuration import VerbSettings
from attentionvote.setting import Setting
@dataclass(frozen=True)
class Rate:
    lr: Annotated[float, Setting("Rate.", above=0, high=10)]
@dataclass(frozen=True, kw_only=True)
class FakeSettings(VerbSettings):
    verb: ClassVar[str] = "fake"
    object: Annotated[dict[str, str], Setting("Part.")]
    trainer: Rate
    do: Annotated[str, Setting("What.")]
    tracking: Annotated[dict[str, Any], Setting("Store.")]
def run(cfg):
    print("a library prints")
    Path(f"pid-{{cfg.do}}").write_text(str(os.getpid()))
    if cfg.do == "bad": raise ValueError("the cloud must be finite, got 3 NaN")
    if cfg.do == "bug": {{}}["missing"]
    if cfg.do == "late":
        with configuring(): raise ValueError("the lock is taken")
    if cfg.do == "crash": os.kill(os.getpid(), signal.SIGSEGV)
    if cfg.do == "silent": os._exit(0)
    if cfg.do == "wait": print("ready", file=sys.stderr, flush=True); time.sleep(60)
    Path(f"out-{{cfg.object['name']}}-{{cfg.trainer.lr}}").touch(exist_ok=False)
    parent = cfg.tracking.get("parent")
    run_id = Path(f"run-{{cfg.object['name']}}").read_text() if parent else None
    about = {{"object": cfg.object["name"], "lr": cfg.trainer.lr, "do": cfg.do}}
    return {{"stage": "fake", **about, "run_id": run_id, "parent": parent}}
def check(cfg):
    if cfg.trainer.lr > 5: raise ValueError(f"lr must be small here, got {{cfg.trainer.lr}}")
if __name__ == "__main__":
    command(FakeSettings, run, check=check, conf=Path({conf!r}))
'''


@pytest.fixture
def verb(tmp_path: Path) -> Path:
    """A script with its configuration folder; tracking.parent is there only with a file of its own."""
    (tmp_path / "conf" / "object").mkdir(parents=True)
    primary = 'defaults: [_self_, {object: "???"}]\ntrainer: {lr: 0.001}\ndo: it\ntracking: {store: null}\n'
    (tmp_path / "conf" / "fake.yaml").write_text(primary, encoding="utf-8")
    for name in ("gear", "brick"):
        (tmp_path / "conf" / "object" / f"{name}.yaml").write_text(f"name: {name}\n", encoding="utf-8")
    script = tmp_path / "fake.py"
    script.write_text(SCRIPT.format(conf=str(tmp_path / "conf")), encoding="utf-8")
    return script


def call(
    script: Path, *words: str, start: Callable[..., subprocess.CompletedProcess[str]] = subprocess.run
) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(script), *words]
    return start(command, cwd=script.parent, capture_output=True, text=True, timeout=100, check=False)


def lines(done: subprocess.CompletedProcess[str]) -> list[dict]:
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_a_grid_runs_job_by_job_without_folders_of_its_own(verb: Path) -> None:
    done = call(verb, "-m", "object=gear,brick", "do=it", "trainer.lr=0.1,0.2")
    assert done.returncode == 0, done.stderr
    assert [(line["object"], line["lr"]) for line in lines(done)] == [
        ("gear", 0.1), ("gear", 0.2), ("brick", 0.1), ("brick", 0.2),
    ]  # fmt: skip
    assert lines(done)[1]["overrides"] == ["object=gear", "do=it", "trainer.lr=0.2"]
    assert "a library prints" in done.stderr
    assert "fake 2 of 4: object=gear trainer.lr=0.2" in done.stderr
    made = sorted(p.name for p in verb.parent.iterdir())
    assert made == ["conf", "fake.py", "out-brick-0.1", "out-brick-0.2", "out-gear-0.1", "out-gear-0.2", "pid-it"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["trainer.lr=0.1,abc"], "trainer.lr must be a number greater than 0 and at most 10; got 'abc'"),
        (["trainer.lr=0.1,6"], "object gear: lr must be small here, got 6"),
        (["trainer.lr=0.1,0.2", "hydra.sweep.dir=x"], "takes no settings of Hydra itself, got 'hydra.sweep.dir=x'"),
    ],
)
def test_a_grid_with_an_impossible_job_does_not_start(verb: Path, words: list[str], message: str) -> None:
    done = call(verb, "object=gear", *words, "-m")
    assert (done.returncode, done.stdout) == (2, "")
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not list(verb.parent.glob("pid-*"))


def test_failures_stop_nobody_and_are_listed_at_the_end(verb: Path) -> None:
    done = call(verb, "--multirun", "object=gear", "do=bad,bug,late,crash,silent,it")
    assert done.returncode == 1
    assert [line.get("failed", "fine") for line in lines(done)][:2] == [
        "the cloud must be finite, got 3 NaN (details in " + log_of(done, "3 NaN"),
        "KeyError: 'missing' (details in " + log_of(done, "KeyError"),
    ]
    assert [line.get("failed", "fine") for line in lines(done)][2:] == [
        "the lock is taken", "its process was ended by SIGSEGV", "it ended without a result", "fine",
    ]  # fmt: skip
    ending = done.stderr.splitlines()[-6:]
    assert ending[0] == "fake: 5 of 6 jobs failed:"
    assert ending[1].startswith("  do=bad: the cloud must be finite, got 3 NaN")
    assert ending[3:] == [
        "  do=late: the lock is taken",
        "  do=crash: its process was ended by SIGSEGV",
        "  do=silent: it ended without a result",
    ]
    assert "Traceback" not in done.stderr


def log_of(done: subprocess.CompletedProcess[str], text: str) -> str:
    """The end of the sentence with ``text``: the file that its details are in."""
    found = re.search(rf"{re.escape(text)}.*\(details in (.*\))", done.stderr)
    assert found
    return found[1]


def started(verb: Path, *words: str) -> subprocess.Popen[str]:
    """A grid whose second job waits."""
    process = subprocess.Popen(
        [sys.executable, str(verb), "-m", "object=gear", "do=it,wait,bad", *words],
        cwd=verb.parent, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stderr is not None
    for line in process.stderr:
        if "ready" in line:
            return process
    raise AssertionError("it ended too early")


def ends(pid: int) -> bool:
    """Whether a process ends within seconds."""
    for _ in range(200):
        try:
            if "\nState:\tZ" in Path(f"/proc/{pid}/status").read_text():
                return True
        except OSError:
            return True
        time.sleep(0.05)
    return False


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interruption_ends_the_grid_and_its_job(verb: Path, number: int, code: int) -> None:
    process = started(verb)
    process.send_signal(number)  # to the grid alone, which passes it on
    out, err = process.communicate(timeout=60)
    assert process.returncode == code
    assert len(out.splitlines()) == 1
    assert err.splitlines()[-1] == "fake: interrupted; run the same command to resume"
    assert "Traceback" not in err
    assert ends(int((verb.parent / "pid-wait").read_text()))
    assert not (verb.parent / "pid-bad").exists()


def test_no_job_outlives_a_killed_grid(verb: Path) -> None:
    process = started(verb)
    process.kill()
    process.communicate(timeout=60)
    assert ends(int((verb.parent / "pid-wait").read_text()))


@pytest.mark.slow
def test_runs_stand_below_one_parent_that_is_found_again(
    verb: Path, put_tables: Callable[[Path], str], tmp_path: Path
) -> None:
    store = put_tables(tmp_path / "mlflow.db")
    conf = tmp_path / "conf" / "fake.yaml"
    conf.write_text(conf.read_text(encoding="utf-8").replace("store: null", "store: null, parent: null"))
    for part in ("gear", "brick"):  # runs that are there already, as of trainings that are complete
        with start_run(store, part, system_interval_s=0) as run:
            (tmp_path / f"run-{part}").write_text(run.id)
    words = ["object=gear,brick", f"tracking.store={store}", "do=it"]
    done = call(verb, "-m", *words, start=warm_starter.run)
    assert done.returncode == 0, done.stderr
    client = connect(resolve_store(store))
    grids = client.get_experiment_by_name("grids").experiment_id
    (parent,) = client.search_runs([grids])
    assert (parent.info.run_name, parent.info.status) == ("fake object=gear,brick", "FINISHED")
    assert parent.data.tags["grid.overrides"] == "object=gear,brick"
    assert (parent.data.tags["grid.done"], parent.data.tags["grid.failed"]) == ("2", "0")
    assert [line["parent"] for line in lines(done)] == [parent.info.run_id] * 2
    runs = [client.get_run(line["run_id"]) for line in lines(done)]
    assert [run.data.tags["mlflow.parentRunId"] for run in runs] == [parent.info.run_id] * 2
    assert len({run.info.experiment_id for run in runs}) == 2  # each in the experiment of its part
    listed = json.loads(Path(client.download_artifacts(parent.info.run_id, "jobs.json", str(tmp_path))).read_text())
    assert [(job["run_id"], job["failed"]) for job in listed] == [(line["run_id"], None) for line in lines(done)]
    # Again, with jobs that fail now (what they make is there) and with another order: the same parent.
    done = call(verb, "-m", "object=brick,gear", *words[1:], start=warm_starter.run)
    assert done.returncode == 1
    (again,) = client.search_runs([grids])
    assert (again.info.run_id, again.info.status, again.data.tags["grid.failed"]) == (parent.info.run_id, "FAILED", "2")


def test_the_parent_of_one_part_lives_with_its_runs(put_tables: Callable[[Path], str], tmp_path: Path) -> None:
    from attentionvote.command import grid as multirun

    store = put_tables(tmp_path / "mlflow.db")
    jobs = [compose(TrainSettings, ["object=gear", f"tracking.store={store}", f"seed={seed}"]) for seed in (1, 2)]
    opened = []
    for chosen in (jobs, jobs[:1], list(reversed(jobs))):
        run = multirun._open_parent("train", "lr=1,2", [["lr=1"], ["lr=2"]], chosen)
        run.close()
        assert run.experiment == "gear"
        opened.append(run.id)
    assert opened[0] == opened[2] != opened[1]
