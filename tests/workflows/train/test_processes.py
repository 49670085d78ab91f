"""One training on several processes, started by the real torchrun: what it comes to, who speaks, what ends it."""

from __future__ import annotations

import io
import json
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import train
from same_training import assert_same_training, runs
from tiny_training import TINY_TRAINING

from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.workflows.train.processes import TrainingProcess, first_speaks, refuse_grid
from attentionvote.workflows.train.settings import TrainSettings
from attentionvote.workflows.train.torchrun import _cause

ROOT = Path(__file__).resolve().parents[3]
# Three scenes to validate and to test: no equal shares. Every proposal is trained on, in small steps: differences of
# rounding then stay what they are for a while.
WORDS = [
    "object=brick", *TINY_TRAINING, "simulation.drop_counts=[1,2,3]", "workers=1", "trainer.max_epochs=4",
    "trainer.validate_every=2", "trainer.average_decay=0.5", "force=false", "trainer.learning_rate=0.001",
    "trainer.peak_threshold=0.0", "trainer.train_heat=0.0", "loss.settings.assignment=0.6",
]  # fmt: skip
# The share by which two orders of additions may come apart in 12 steps. Measured in double precision: 3e-14 of a loss,
# 1e-11 of all weights; 5e-7 where a checkpoint was rounded to float32 on the way. In float32 it depends on the
# processor, 9e-5 of a loss on one and 2e-3 on another: Adam makes whole steps of gradients whose sign is rounding.
IN_DOUBLE, IN_SINGLE = 1e-8, 2e-2
TORCHRUN_SAYS = {
    "RANK": "1", "WORLD_SIZE": "4", "LOCAL_RANK": "1", "LOCAL_WORLD_SIZE": "2", "TORCHELASTIC_RUN_ID": "none"
}  # fmt: skip

Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts a training on so many processes; what still runs when the test ends is killed."""
    with ExitStack() as stack:

        def begin(processes: int, words: list[str], **environment: str) -> subprocess.Popen[str]:
            several = ["pipelines/start_processes.py", "--standalone", f"--nproc-per-node={processes}"]
            process = stack.enter_context(
                subprocess.Popen(
                    [sys.executable, *(several if processes > 1 else []), "pipelines/train.py", *words],
                    cwd=ROOT,
                    text=True,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    env={**os.environ, **environment},
                )
            )
            stack.callback(process.kill)
            return process

        yield begin


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[list[str]], dict[str, Any]]]:
    """Trains in this process, which has imported everything already; without figures, each of which takes a second."""
    import torch

    from attentionvote.drawing import figures, scene_pictures

    for module in (scene_pictures, figures):
        for name in ("scene_picture", "loss_figure", "precision_recall_figure", "ap_threshold_figure"):
            monkeypatch.setattr(module, name, lambda *_, **__: b"picture", raising=False)
    threads, level = torch.get_num_threads(), logging.getLogger("lightning.pytorch").level
    yield lambda words: json.loads(json.dumps(train.run(compose(TrainSettings, words))))
    torch.set_num_threads(threads)
    logging.getLogger("lightning.pytorch").setLevel(level)


def test_torchrun_s_environment_is_understood(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # else it is set for the rest of the session
    assert TrainingProcess.of({}) == TrainingProcess.of({"WORLD_SIZE": "1", "RANK": "0"}) == TrainingProcess()
    place = TrainingProcess.of(TORCHRUN_SAYS)
    assert (place.rank, place.processes, place.local_rank, place.local_processes) == (1, 4, 1, 2)
    assert place.name == "process 2 of 4"
    assert place.trainer_arguments()["num_nodes"] == 2
    assert TrainingProcess().trainer_arguments() == {"devices": 1}
    for name in ("RANK", "LOCAL_WORLD_SIZE", "TORCHELASTIC_RUN_ID"):
        with pytest.raises(ConfigurationError, match=f"must be started by torchrun, but WORLD_SIZE is 4 and {name} is"):
            TrainingProcess.of({k: v for k, v in TORCHRUN_SAYS.items() if k != name})
    with pytest.raises(ConfigurationError, match="2 on this one are no equal share of 3"):
        TrainingProcess.of(TORCHRUN_SAYS | {"WORLD_SIZE": "3"})


def test_what_cannot_be_shared_is_refused() -> None:
    place, scenes = TrainingProcess.of(TORCHRUN_SAYS), {"train": 100, "val": 7, "test": 4}
    place.check(16, scenes)
    for batch, nearest in ((15, 16), (17, 16), (1, 4)):
        with pytest.raises(ValueError, match=f"multiple of their number, 4; got {batch}, {nearest} is the nearest"):
            place.check(batch, scenes)
    with pytest.raises(ValueError, match="processes must be at most the 3 test scenes, got 4"):
        place.check(16, scenes | {"test": 3})
    with pytest.raises(ConfigurationError, match=r"a grid \(-m\) must be run by one process, got 4"):
        refuse_grid(place, ["train.py", "-m", "seed=1,2"])
    refuse_grid(TrainingProcess(), ["train.py", "-m", "seed=1,2"])
    refuse_grid(place, ["train.py", "seed=1"])


def test_a_refusal_is_said_once_a_machine_and_at_once(start: Start, tmp_path: Path) -> None:
    def said(rank: int, local_rank: int, *words: str) -> str:
        place = TORCHRUN_SAYS | {"RANK": str(rank), "LOCAL_RANK": str(local_rank)}
        process = start(1, [*WORDS, f"outputs={tmp_path}", *words], **place)
        out, err = process.communicate(timeout=60)
        assert (process.returncode, out) == (2, "")
        return err

    batch = "trainer.batch_size is shared by all processes and must be a multiple of their number, 4; got 6, 8 is the"
    assert said(0, 0, "trainer.batch_size=6").startswith(f"train: {batch}")
    assert said(1, 1, "trainer.batch_size=6") == ""
    assert said(2, 0, "trainer.batch_size=6").startswith(f"train: process 3 of 4: {batch}")
    assert said(3, 1, "trainer.max_epoch=3") == ""
    assert "a grid (-m) must be run by one process" in said(0, 0, "-m", "seed=1,2")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("processes", ["0", "abc"])
def test_a_number_of_processes_that_is_none_is_one_sentence(processes: str) -> None:
    words = ["--standalone", f"--nproc-per-node={processes}", "pipelines/train.py", "object=gear"]
    answer = subprocess.run(
        [sys.executable, "pipelines/start_processes.py", *words], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert answer.stderr == f"train: PROCESSES must be a whole number of at least 1, got {processes}\n"
    assert (answer.returncode, answer.stdout) == (2, "")


@pytest.mark.parametrize(("exit_codes", "cause"), [((1, -9), 1), ((-9, 1), 0), ((1, 2), 0), ((-9, -11), 0)])
def test_what_a_signal_ended_is_the_cause_whoever_is_seen_first(exit_codes: tuple[int, ...], cause: int) -> None:
    """As torchrun finds them: one after the other, in the order of their ranks."""
    failures = {rank: SimpleNamespace(exitcode=code, timestamp=100.0 + rank) for rank, code in enumerate(exit_codes)}
    rank, failure = _cause(failures)  # type: ignore[arg-type]
    assert (rank, failure.exitcode) == (cause, exit_codes[cause])


def test_another_process_only_says_why_it_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = RuntimeError("[../gloo/transport/tcp/pair.cc:547] Connection closed by peer [127.0.0.1]:31")

    def said(place: TrainingProcess, error: Exception, raised: type[Exception], message: str) -> str:
        terminal = io.StringIO()

        def fail() -> None:
            with first_speaks(place):
                print("progress", file=sys.stderr)
                raise error

        with monkeypatch.context() as patch:
            patch.setattr(sys, "stderr", terminal)
            patch.setattr(sys, "__stderr__", terminal)
            with pytest.raises(raised, match=message):
                fail()
            assert (logging.root.manager.disable >= logging.CRITICAL) == (place.rank > 0)
            logging.disable(logging.NOTSET)
            if sys.stderr is not terminal:
                sys.stderr.close()
        assert ("progress" in terminal.getvalue()) == (place.rank == 0)
        return terminal.getvalue().replace("progress\n", "")

    first, second = TrainingProcess(0, 2, 0, 2), TrainingProcess(1, 2, 1, 2)
    damaged = ValueError("cloud 3 is damaged")
    assert said(second, damaged, ValueError, "cloud 3") == "train: process 2 of 2: cloud 3 is damaged\n"
    assert said(first, damaged, ValueError, "cloud 3") == ""  # the verb says it, as with one process
    for place in (first, second):
        assert said(place, broken, ConnectionError, "another process of this training has ended; run the same") == ""
    assert said(TrainingProcess(), broken, RuntimeError, "closed by peer") == ""
    elsewhere = ConfigurationError("object bunny: no mesh")
    assert said(second, elsewhere, ConfigurationError, "bunny") == ""
    assert said(TrainingProcess(8, 16, 0, 8), elsewhere, ConfigurationError, "bunny") == (
        "train: process 9 of 16: object bunny: no mesh\n"
    )


def until(process: subprocess.Popen[str], ready: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 240
    while not ready():
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.005)


def child_of_rank(torchrun: int, rank: int) -> int:
    for child in Path(f"/proc/{torchrun}/task/{torchrun}/children").read_text().split():
        if f"\0RANK={rank}\0" in Path(f"/proc/{child}/environ").read_text():
            return int(child)
    raise AssertionError(f"no child of rank {rank}")


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_two_processes_train_what_one_trains_whatever_interrupts_them(
    start: Start, alone: Callable[[list[str]], dict[str, Any]], put_tables: Callable[[Path], str], tmp_path: Path
) -> None:
    database = tmp_path / "mlflow.db"
    put_tables(database)
    single = [*WORDS, f"root={tmp_path / 'data'}", f"tracking.store={database}"]
    common = [*single, "trainer.precision=64-true"]
    process = start(2, [*common, f"outputs={tmp_path / 'two'}"])  # the first process makes the data
    out, err = process.communicate(timeout=250)
    assert process.returncode == 0, err
    assert out.count("\n") == 1
    two = json.loads(out)
    assert err.count("brick: 12/3/3 scenes") == 1
    assert err.count("AP ") == len(err.splitlines()) - err.count("brick") == 3, err  # two validations and the end
    assert "1 thread in each of 2 processes" in err
    folder = tmp_path / "two" / "brick"
    (training,) = folder.iterdir()
    assert {p.name for p in training.iterdir()} == {".lock", "checkpoints", "model.ckpt", "result.json", "run.json"}
    assert runs(database) == [two["run_id"]]

    one = alone([*common, f"outputs={tmp_path / 'one'}"])
    assert Path(one["model"]).parent.name == training.name  # the same training, whoever does it
    assert_same_training(one, two, database, IN_DOUBLE)

    # Ctrl-C, then SIGTERM, then kill -9 of one process, then the rest in one process.
    words = [*common, f"outputs={tmp_path / 'cut'}"]
    last = tmp_path / "cut" / "brick" / training.name / "checkpoints" / "last.ckpt"
    process = start(2, words)
    until(process, last.exists)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=40)
    assert (process.returncode, out) == (130, "")
    assert err.count("train: ") == err.count("train: interrupted; run the same command to resume") == 1
    assert "Traceback" not in err
    before = last.stat().st_mtime_ns
    process = start(2, words)
    until(process, lambda: last.stat().st_mtime_ns > before)
    children = [child_of_rank(process.pid, rank) for rank in (0, 1)]
    process.send_signal(signal.SIGTERM)  # to the starter alone, as a scheduler does
    out, err = process.communicate(timeout=40)
    assert (process.returncode, out) == (143, "")
    assert err.count("train: ") == err.count("train: interrupted; run the same command to resume") == 1
    assert "Traceback" not in err
    assert not [child for child in children if Path(f"/proc/{child}").exists()]
    before = last.stat().st_mtime_ns
    process = start(2, words)
    until(process, lambda: last.stat().st_mtime_ns > before)
    os.kill(child_of_rank(process.pid, 1), signal.SIGKILL)
    out, err = process.communicate(timeout=40)
    assert (process.returncode, out) == (137, "")
    assert "going on after an interruption" in err
    assert err.count("train: process 2 was ended by SIGKILL") == 1
    # What reaches the first process first: the broken connection, or torchrun's SIGTERM, which needs no words.
    assert err.count("train: ") - 1 == err.count("train: another process of this training has ended; run the same")
    assert "Traceback" not in err
    assert_same_training(one, alone(words), database, IN_DOUBLE)

    # Single precision, where the C functions of the network work, ends the same.
    assert_same_training(two, alone([*single, f"outputs={tmp_path / 'single'}"]), database, IN_SINGLE)
    assert len(runs(database)) == 4
