"""One meaning on all executors: every job once, deaths are repaired, exceptions come back, closing ends the work."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from execution_tasks import Marked, environment, raising, square

from attentionvote.execution import Executor, LocalPool, RayCluster, SlurmArray, WorkerDied, executor_named, run_all

pytestmark = pytest.mark.slow


@pytest.fixture
def marks(tmp_path: Path) -> Path:
    folder = tmp_path / "marks"
    folder.mkdir()
    return folder


def count(marks: Path, what: str) -> int:
    return len(list(marks.glob(f"{what}-*")))


def test_every_job_comes_back_once_and_the_task_stays_in_its_worker(executor: Executor, marks: Path) -> None:
    results = list(run_all(Marked(marks, seconds=0.02), list(range(12)), executor, workers=2))
    assert sorted(index for index, _ in results) == list(range(12))
    processes = {process for _, (process, _) in results}
    assert os.getpid() not in processes
    assert 1 <= len(processes) <= 2
    # The n-th call of the object in its process: it was built once there.
    for process in processes:
        calls = sorted(call for _, (p, call) in results if p == process)
        assert calls == list(range(1, len(calls) + 1))
    assert count(marks, "begin") == count(marks, "end") == 12


def test_a_killed_workers_job_is_done_again_and_no_other(executor: Executor, marks: Path) -> None:
    results = list(run_all(Marked(marks, {3: 2}), list(range(6)), executor, workers=2, retries=2))
    assert sorted(index for index, _ in results) == list(range(6))
    assert [count(marks, f"end-{job}") for job in range(6)] == [1] * 6
    assert count(marks, "begin-3") == 3


def test_a_job_that_kills_its_workers_is_one_sentence(executor: Executor, marks: Path) -> None:
    with pytest.raises(
        WorkerDied, match=r"^a worker process died \(out of memory\? .+\) 2 times at job 1 after \d of 4 jobs; what is"
    ) as caught:
        list(run_all(Marked(marks, {1: 9}), list(range(4)), executor, workers=2, retries=1))
    assert (caught.value.job, caught.value.times, caught.value.total) == (1, 2, 4)
    assert count(marks, "begin-1") == 2
    assert count(marks, "end-1") == 0


@pytest.mark.parametrize(
    ("job", "kind", "message"),
    [
        ("value", ValueError, "the part has no mesh"),
        ("odd", RuntimeError, "OddError: one and two"),  # its class cannot be rebuilt from its arguments
        ("unpicklable", TypeError, "the result of a job must be picklable, got function: "),
    ],
)
def test_what_a_task_raises_is_raised_as_it_was(
    executor: Executor, job: str, kind: type[Exception], message: str
) -> None:
    with pytest.raises(kind) as caught:  # match= would see the notes as well
        list(run_all(raising, [job, "fine"], executor, workers=2))
    assert type(caught.value) is kind
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)
    assert caught.value.__notes__[0].startswith("In the worker:\n")


def test_workers_have_their_threads_and_our_folder(executor: Executor) -> None:
    names = ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"]
    before = {name: os.environ.get(name) for name in names}
    results = dict(
        run_all(environment, names, executor, workers=2, threads=2 if isinstance(executor, RayCluster) else 3)
    )
    assert {value for _, value, _ in results.values()} == {"2" if isinstance(executor, RayCluster) else "3"}
    assert {folder for *_, folder in results.values()} == {str(Path.cwd())}
    assert {name: os.environ.get(name) for name in names} == before


def test_a_job_of_ray_that_takes_no_gpu_sees_none(ray_cluster: RayCluster) -> None:
    name = "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO"  # hides GPUs, which a machine without any cannot show
    ((_, (_, value, _)),) = run_all(environment, [name], ray_cluster, workers=2)
    assert value == "1"


def test_leaving_early_ends_the_workers(executor: Executor, marks: Path) -> None:
    with closing(run_all(Marked(marks, seconds=1.0), list(range(20)), executor, workers=2)) as results:
        next(results)
    ended = count(marks, "end")
    time.sleep(1.5)
    assert count(marks, "end") == ended <= 4
    assert not multiprocessing.active_children()


def test_a_job_that_no_machine_can_take_does_not_wait_for_ever(ray_cluster: RayCluster) -> None:
    message = "must have 3 cores and 0 GPUs for a job, but they have 2 cores and 0 GPUs: lower threads or cluster.gpus"
    with pytest.raises(ValueError, match=message):
        list(run_all(square, [1], ray_cluster, threads=3))
    with pytest.raises(ValueError, match="must have 1 cores and 1 GPUs for a job"):
        list(run_all(square, [1], RayCluster(gpus=1)))


def test_no_jobs_need_no_worker(executor: Executor) -> None:
    assert list(run_all(square, [], executor, workers=2)) == []


# Without workers.


def test_one_worker_of_this_machine_is_this_process(marks: Path) -> None:
    results = list(run_all(Marked(marks), [5, 6]))
    assert results == [(0, (os.getpid(), 1)), (1, (os.getpid(), 2))]
    with pytest.raises(ValueError, match="no mesh"):
        list(run_all(raising, ["value"]))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"workers": 0}, "workers must be at least 1, got 0"),
        ({"retries": -1}, "retries must be at least 0, got -1"),
        ({"threads": 0}, "threads must be at least 1, got 0"),
    ],
)
def test_impossible_arguments_are_refused_at_once(settings: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        run_all(square, [1], **settings)  # not even iterated


def test_executors_by_name(tmp_path: Path) -> None:
    assert executor_named("local", {}) == LocalPool()
    assert executor_named("ray", {"address": "auto", "gpus": 0.5}) == RayCluster("auto", 0.5)
    slurm = {"folder": str(tmp_path), "system": "local", "minutes": 5}
    assert executor_named("slurm", {"gpus": 1.0, "slurm": slurm}) == SlurmArray(tmp_path, "local", 5, gpus=1.0)
    with pytest.raises(ValueError, match="executor must be one of local, ray, slurm; got 'dask'"):
        executor_named("dask", {})


@pytest.mark.parametrize(("name", "package"), [("ray", "ray"), ("slurm", "submitit")])
def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch, name: str, package: str) -> None:
    monkeypatch.setitem(sys.modules, package, None)  # type: ignore[arg-type]
    message = rf"executor={name} needs the package {package}, which is not installed: install the extra cluster"
    with pytest.raises(ValueError, match=message):
        executor_named(name, {"slurm": {"system": "local"}})


def test_slurm_without_sbatch_or_with_parts_of_a_gpu_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(
        ValueError, match="executor=slurm must be used where jobs can be submitted, but there is no sbat"
    ):
        executor_named("slurm", {})
    with pytest.raises(ValueError, match=r"cluster.gpus must be a whole number with executor=slurm; got 0.5"):
        executor_named("slurm", {"gpus": 0.5, "slurm": {"system": "local"}})
    with pytest.raises(ValueError, match=r"cluster.slurm.system must be slurm or local; got 'pbs'"):
        executor_named("slurm", {"slurm": {"system": "pbs"}})


def test_an_array_is_asked_for_as_sbatch_wants_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The real submitit against an sbatch that writes down what it is given: no SLURM is needed for that."""
    sbatch = f"cat \"$1\" > {tmp_path}/asked\necho 'Submitted batch job 77'"
    for program, text in (
        ("sbatch", sbatch),
        ("srun", ""),
        ("sacct", ""),
        ("scancel", f"echo $* >> {tmp_path}/cancelled"),
    ):
        (tmp_path / program).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / program).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    array = SlurmArray(tmp_path / "runs", minutes=90, memory_gb=4, partition="cpu", account="lab", gpus=1, poll_s=0.05)
    array.check()
    results = run_all(square, list(range(100)), array, workers=8, threads=3)
    with closing(results):
        answer = _first_of_an_array(results, tmp_path / "runs")
    asked = set((tmp_path / "asked").read_text().splitlines())
    assert answer == (17, 289)
    for line in ("--array=0-31%8", "--time=90", "--cpus-per-task=3", "--mem=4GB", "--partition=cpu", "--account=lab"):
        assert f"#SBATCH {line}" in asked
    assert "#SBATCH --gpus-per-node=1" in asked
    assert "77" in (tmp_path / "cancelled").read_text()


def _first_of_an_array(results: Iterator[tuple[int, int]], runs: Path) -> tuple[int, int]:
    """The first result, where an outcome comes from no real machine but from this thread."""
    import pickle
    import threading

    def finish() -> None:
        for _ in itertools.repeat(None, 400):
            for call in runs.glob("*/outcomes"):
                (call / "17").write_bytes(pickle.dumps((True, 289)))
                return
            time.sleep(0.05)

    thread = threading.Thread(target=finish)
    thread.start()
    try:
        return next(results)
    finally:
        thread.join()
