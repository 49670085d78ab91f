"""Real worker processes: what they answer, and what happens to everybody else when one is stopped, killed or fed."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from attentionvote.inference.bundles.bundle import Bundle, load_bundle
from attentionvote.inference.errors import BundleError
from attentionvote.inference.server.deadline import Deadline
from attentionvote.inference.server.worker import workers as workers_module
from attentionvote.inference.server.worker.channel import Message, SharedContent
from attentionvote.inference.server.worker.process import WorkerLost, WorkerProcess, WorkerSettings
from attentionvote.inference.server.worker.workers import Workers

Make = Callable[..., Path]
PATIENCE_S = 20.0


@pytest.fixture
def bundle(make_bundle: Make, trusted_key: Path) -> Bundle:
    """Verified."""
    return load_bundle(make_bundle(), trusted_key)


@pytest.fixture
def losses() -> list[str]:
    """Reasons that were told."""
    return []


@pytest.fixture
def workers(bundle: Bundle, losses: list[str]) -> Iterator[Workers]:
    """A pair, both loaded; a job may take 24 MiB."""
    settings = WorkerSettings(job_memory_bytes=24 * 1024 * 1024)
    made = Workers(bundle, settings, lost=losses.append)
    wait_for(lambda: made._spare is not None)
    yield made
    made.close()


def wait_for(condition: Callable[[], bool]) -> None:
    until = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.01)


def ask(workers: Workers, body: bytes, seconds: float = PATIENCE_S) -> Message | None:
    with SharedContent.of(body) as content:
        return workers.ask({"kind": "file"}, content, Deadline(seconds))


def busy_pids(workers: Workers) -> list[int]:
    with workers._changed:
        return [pid_of(worker) for worker in workers._since]


def pid_of(worker: WorkerProcess | None) -> int:
    assert worker is not None
    return worker._process.pid


def test_a_body_is_read_and_answered(workers: Workers, make_cloud: Any, npy: Any) -> None:
    answer = ask(workers, npy(make_cloud()))
    assert answer is not None
    assert (answer.head["status"], answer.head["outcome"], answer.head["detections"]) == (200, "ok", 2)
    assert answer.head["points"] == 3000
    assert set(answer.head["seconds"]) == {"parse", "estimate"}
    assert len(json.loads(bytes(answer.content))["poses"]) == 2
    refused = ask(workers, b"nothing")
    assert refused is not None
    assert (refused.head["status"], refused.head["outcome"]) == (400, "rejected")
    assert "must be a point cloud" in refused.head["error"]


def test_a_job_that_does_not_end_is_killed_and_the_spare_answers(
    workers: Workers, losses: list[str], make_cloud: Any, npy: Any
) -> None:
    stuck, spare = pid_of(workers._active), pid_of(workers._spare)
    os.kill(stuck, signal.SIGSTOP)  # whatever it is doing: a loop in C does not listen either
    begun = time.monotonic()
    with pytest.raises(WorkerLost, match="ran 1 s beyond its deadline and was killed") as caught:
        ask(workers, npy(make_cloud()), 0.2)
    assert caught.value.reason == "deadline"
    assert 1.1 < time.monotonic() - begun < 2.5
    begun = time.monotonic()
    assert ask(workers, npy(make_cloud())) is not None
    assert time.monotonic() - begun < 3.0
    assert pid_of(workers._active) == spare
    assert losses == ["deadline"]
    assert not Path(f"/proc/{stuck}").exists()
    wait_for(lambda: workers._spare is not None)
    assert pid_of(workers._spare) not in (stuck, spare)


def test_a_stuck_worker_without_a_spare_is_not_available(workers: Workers, make_cloud: Any, npy: Any) -> None:
    stuck = workers._active
    assert stuck is not None
    os.kill(pid_of(stuck), signal.SIGSTOP)

    def lose() -> None:
        with pytest.raises(WorkerLost):
            ask(workers, npy(make_cloud()), 0.1)

    asking = threading.Thread(target=lose)
    asking.start()
    wait_for(lambda: stuck.overdue)
    assert workers.available  # the spare would take over
    spare, workers._spare = workers._spare, None
    assert not workers.available
    workers._spare = spare
    asking.join()
    assert workers.available


def test_a_job_that_hangs_keeps_the_next_ones_waiting_for_a_second(workers: Workers, make_cloud: Any, npy: Any) -> None:
    os.kill(pid_of(workers._active), signal.SIGSTOP)
    with ThreadPoolExecutor(1) as pool:
        hanging = pool.submit(ask, workers, npy(make_cloud()), 8.0)
        wait_for(lambda: bool(workers._since))
        begun = time.monotonic()
        for _ in range(3):
            answer = ask(workers, npy(make_cloud()))
            assert answer is not None
            assert answer.head["status"] == 200
        assert 0.8 < time.monotonic() - begun < 3.0  # the first one waits for a second, the others for nobody
        assert not hanging.done()
        os.kill(pid_of(workers._active), signal.SIGCONT)
        assert hanging.result(PATIENCE_S) is not None


def test_jobs_are_done_in_their_order(
    make_bundle: Make, trusted_key: Path, make_cloud: Any, npy: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers_module, "_PATIENCE_S", 1000.0)  # on a busy machine the spare would take the next
    slow = Workers(load_bundle(make_bundle(graph={"loops": 100_000}), trusted_key), WorkerSettings())
    done: list[int] = []

    def job(number: int) -> None:
        assert ask(slow, npy(make_cloud(seed=number))) is not None
        done.append(number)

    with closing(slow), ThreadPoolExecutor(4) as pool:
        jobs = [pool.submit(job, 0)]
        wait_for(lambda: slow._active in slow._since or bool(done))
        for number in range(1, 4):
            jobs.append(pool.submit(job, number))
            wait_for(lambda before=number: len(slow._line) + len(done) >= before)  # one is at work
        for answer in jobs:
            answer.result(PATIENCE_S)
    assert done == [0, 1, 2, 3]


def test_retired_workers_end_when_nobody_holds_them(workers: Workers) -> None:
    workers.hold()
    workers.retire()
    assert workers.available
    workers.release()
    assert not workers.available


def test_a_body_that_takes_too_much_memory_is_refused_and_nothing_else(
    workers: Workers, losses: list[str], make_cloud: Any, npy: Any
) -> None:
    pid = pid_of(workers._active)
    for _ in range(5):
        answer = ask(workers, npy(np.repeat(make_cloud(), 1000, axis=0)))
        assert answer is not None
        assert answer.head["status"] == 422
        assert "start the server with a larger --job-memory-mb" in answer.head["error"]
        assert workers.available
    assert (losses, pid_of(workers._active)) == ([], pid)  # it has given the memory back
    good = ask(workers, npy(make_cloud()))
    assert good is not None
    assert good.head["status"] == 200


def test_a_job_that_cannot_be_sent_costs_nothing(workers: Workers, make_cloud: Any, npy: Any) -> None:
    with SharedContent.of(npy(make_cloud())) as content:
        for _ in range(2):
            with pytest.raises(ValueError, match="a message must have at most"):
                workers.ask({"kind": "x" * 200_000}, content, Deadline(0.05))
    time.sleep(0.7)
    assert workers.available
    assert not any(worker.overdue or worker.ended_idle for worker in workers._both())
    assert ask(workers, npy(make_cloud())) is not None


def test_workers_are_as_important_as_the_server_but_while_they_load(bundle: Bundle) -> None:
    for polite in (False, True):
        worker = WorkerProcess(bundle, WorkerSettings(), self_test=False, polite=polite)
        assert os.getpriority(os.PRIO_PROCESS, pid_of(worker)) == os.getpriority(os.PRIO_PROCESS, 0)
        worker.kill()


@pytest.mark.parametrize(("number", "reason"), [(signal.SIGSEGV, "crashed"), (signal.SIGKILL, "memory")])
def test_a_worker_that_ends_in_its_work_is_replaced(
    make_bundle: Make, trusted_key: Path, losses: list[str], make_cloud: Any, npy: Any, number: int, reason: str
) -> None:
    slow = load_bundle(make_bundle(graph={"loops": 400_000}), trusted_key)
    workers = Workers(slow, WorkerSettings(), lost=losses.append)
    wait_for(lambda: workers._spare is not None)
    first = pid_of(workers._active)
    threading.Timer(0.2, os.kill, (first, number)).start()
    answer = ask(workers, npy(make_cloud()))
    assert answer is not None  # the job may not be at fault: the spare has done it
    assert answer.head["status"] == 200
    assert losses == [reason]
    wait_for(lambda: workers._spare is not None)

    def kill_whoever_works() -> None:
        for pid in (pid_of(workers._active), pid_of(workers._spare)):
            wait_for(lambda pid=pid: pid in busy_pids(workers))
            time.sleep(0.2)  # it has begun: one that ends before costs the job nothing
            os.kill(pid, number)

    killer = threading.Thread(target=kill_whoever_works)
    killer.start()
    with pytest.raises(WorkerLost) as caught:
        ask(workers, npy(make_cloud()))
    killer.join()
    assert caught.value.reason == reason
    assert signal.Signals(number).name in caught.value.detail
    assert losses == [reason] * 3
    assert ask(workers, npy(make_cloud())) is not None
    workers.close()


def test_a_spare_that_does_not_listen_is_replaced_before_it_is_needed(workers: Workers, losses: list[str]) -> None:
    deaf = pid_of(workers._spare)
    os.kill(deaf, signal.SIGSTOP)
    wait_for(lambda: losses == ["deadline"])
    wait_for(lambda: workers._spare is not None and pid_of(workers._spare) != deaf)
    assert not Path(f"/proc/{deaf}").exists()


def test_workers_that_end_idle_cost_no_request(workers: Workers, losses: list[str], make_cloud: Any, npy: Any) -> None:
    for worker in (workers._active, workers._spare):
        os.kill(pid_of(worker), signal.SIGKILL)
    answer = ask(workers, npy(make_cloud()))
    assert answer is not None
    assert answer.head["status"] == 200
    wait_for(lambda: workers._spare is not None and workers._active is not None)
    assert losses == ["crashed", "crashed"]


def test_a_body_s_own_deadline_replaces_the_other(workers: Workers, make_cloud: Any, infer_body: Any) -> None:
    body, headers = infer_body(make_cloud(), deadline_ms=30_000)
    job = {"kind": "infer", "header_length": headers["Inference-Header-Content-Length"], "most_deadline_ms": 9000.0}
    deadline = Deadline(5.0)
    with SharedContent.of(body) as content:
        answer = workers.ask(job, content, deadline)
    assert answer is not None
    assert answer.head["status"] == 200
    assert deadline.budget_s == 9.0


def test_a_self_test_that_does_not_end_refuses_the_bundle(make_bundle: Make, trusted_key: Path) -> None:
    endless = load_bundle(make_bundle(graph={"loops": 10**15}), trusted_key)
    begun = time.monotonic()
    with pytest.raises(BundleError, match="the self-test must end within 2 s, but it did not"):
        Workers(endless, WorkerSettings(load_s=2.0))
    assert time.monotonic() - begun < 5.0


def test_a_bundle_that_answers_otherwise_is_refused(make_bundle: Make, trusted_key: Path) -> None:
    def spoil(folder: Path) -> None:
        file = folder / "golden" / "cloud_0.npz"
        arrays = dict(np.load(file))
        arrays["camera_from_part"][0, 0, 3] += 0.01
        np.savez(file, **arrays)

    bundle = load_bundle(make_bundle(change=spoil), trusted_key)
    with pytest.raises(BundleError, match=r"the self-test failed: golden cloud cloud_0 .* export the bundle again"):
        Workers(bundle, WorkerSettings())


def test_nobody_is_left_when_the_server_dies(bundle: Bundle) -> None:
    """The kernel ends a worker with the server's end of its lifeline, also while it does not listen."""
    worker = WorkerProcess(bundle, WorkerSettings(), self_test=False, polite=False)
    os.kill(pid_of(worker), signal.SIGSTOP)
    os.close(worker._lifeline)
    os.kill(pid_of(worker), signal.SIGCONT)
    assert worker._process.wait(PATIENCE_S) == -signal.SIGIO
    worker._lifeline = os.open(os.devnull, os.O_RDONLY)
    worker.kill()


def test_nothing_is_left_open(bundle: Bundle) -> None:
    def pair_that_ends() -> None:
        Workers(bundle, WorkerSettings()).close()
        wait_for(lambda: not any(thread.name == "spare worker" for thread in threading.enumerate()))

    pair_that_ends()
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(3):
        pair_that_ends()
    assert len(os.listdir("/proc/self/fd")) == before
