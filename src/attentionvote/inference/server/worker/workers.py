"""The workers of one model: one that answers and a spare that stands loaded, for the moment the first one is lost."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from attentionvote.contract import ModelCard
from attentionvote.inference.bundles.bundle import Bundle
from attentionvote.inference.server.deadline import Deadline
from attentionvote.inference.server.json_logs import say
from attentionvote.inference.server.worker.channel import PING, Message, SharedContent
from attentionvote.inference.server.worker.process import Loss, WorkerEnded, WorkerLost, WorkerProcess, WorkerSettings

_TRIES = 5
_PATIENCE_S = 1.0  # how long a job may keep the next one waiting
_PING_S, _PING_EVERY_S = 0.5, 1.0
_LOOK_S, _FIRST_RETRY_S, _LAST_RETRY_S = 0.5, 1.0, 60.0


class Workers:
    """Two processes with one verified and self-tested bundle.

    One job runs at a time, in the order of their coming. A job that runs for a second keeps nobody waiting any longer:
    the next one goes to the spare.

    Args:
        bundle: verified.
        settings: of every worker.
        polite: whether loading gives way to requests: another model serves meanwhile.
        lost: told the reason whenever a worker was lost.

    Attributes:
        card: the model's.
        digest: of the bundle.

    Raises:
        BundleError: when the bundle cannot be loaded, or fails its self-test.
        OSError: when there is no process or memory to be had.
    """

    def __init__(
        self,
        bundle: Bundle,
        settings: WorkerSettings,
        *,
        polite: bool = False,
        lost: Callable[[Loss], None] = lambda _: None,
    ) -> None:
        self.card: ModelCard = bundle.card
        self.digest: str = bundle.digest
        self._bundle, self._settings, self._tell = bundle, settings, lost
        self._changed = threading.Condition()
        self._closed = self._retired = False
        self._users = 0
        self._line: deque[object] = deque()  # who waits, in order
        self._since: dict[WorkerProcess, float] = {}  # when each busy worker began
        self._active: WorkerProcess | None = WorkerProcess(bundle, settings, self_test=True, polite=polite)
        self._spare: WorkerProcess | None = None
        threading.Thread(target=self._keep_a_spare, name="spare worker", daemon=True).start()

    @property
    def available(self) -> bool:
        """Whether a request would be worked on: a loaded worker is there that is not beyond a deadline."""
        with self._changed:
            return not self._closed and any(worker.alive and not worker.overdue for worker in self._both())

    @property
    def memory_bytes(self) -> int:
        """Resident memory of both."""
        with self._changed:
            return sum(worker.memory_bytes for worker in self._both())

    def hold(self) -> None:
        """Somebody will ask: they are not closed before :meth:`release`."""
        with self._changed:
            self._users += 1

    def release(self) -> None:
        """Whoever held them does not ask any more."""
        with self._changed:
            self._users -= 1
            over = self._retired and not self._users
        if over:
            self.close()

    def retire(self) -> None:
        """Close them as soon as nobody holds them."""
        with self._changed:
            self._retired = True
            over = not self._users
        if over:
            self.close()

    def ask(
        self,
        job: dict[str, Any],
        content: SharedContent,
        deadline: Deadline,
    ) -> Message | None:
        """Let a worker do a job; None when the deadline passed before there was one.

        Raises:
            WorkerLost: the job was lost with its worker, or with a second one after the first had ended in it.
            RuntimeError: when they are closed.
        """
        crashed = False
        for _ in range(_TRIES):
            worker = self._take(deadline)
            if worker is None:
                break
            try:
                answer = worker.ask(job, content, deadline)
            except WorkerEnded:  # while nobody asked: this job goes to the next one
                self._drop(worker, "crashed", "a worker ended while it had nothing to do")
                continue
            except WorkerLost as loss:
                self._drop(worker, loss.reason, loss.detail)
                if loss.reason == "deadline" or crashed:
                    raise
                crashed = True  # perhaps by no fault of this job: a second worker tells
                continue
            finally:
                self._free(worker)
            if answer.head.get("ends"):
                self._drop(worker, "memory", "a job took more memory than it may, and did not give it back")
            return answer
        return None

    def close(self) -> None:
        """End both at once; a job that runs is lost."""
        with self._changed:
            self._closed = True
            workers = self._both()
            self._active = self._spare = None
            self._changed.notify_all()
        for worker in workers:
            worker.kill()

    def _both(self) -> list[WorkerProcess]:
        return [worker for worker in (self._active, self._spare) if worker is not None]

    def _take(self, deadline: Deadline) -> WorkerProcess | None:
        """The worker for the next job in line; while there is none, it is waited for until the deadline."""
        turn = object()
        with self._changed:
            self._line.append(turn)
            try:
                while not self._closed:
                    worker = self._idle() if self._line[0] is turn else None
                    if worker is not None:
                        self._since[worker] = time.monotonic()
                        return worker
                    left = deadline.remaining_s()
                    if left <= 0:
                        return None
                    self._changed.wait(min(left, _PATIENCE_S / 4))
            finally:
                self._line.remove(turn)
                self._changed.notify_all()
        raise RuntimeError("the workers are closed: a request came after the server's end")

    def _idle(self) -> WorkerProcess | None:
        """The active worker when it has nothing to do, the spare when that one's job takes long."""
        if self._active is None:
            self._active, self._spare = self._spare, None
            self._changed.notify_all()
        if self._active is None or self._active not in self._since:
            return self._active
        if self._spare in self._since or time.monotonic() - self._since[self._active] < _PATIENCE_S:
            return None
        return self._spare

    def _free(self, worker: WorkerProcess) -> None:
        """A worker has nothing to do any more."""
        with self._changed:
            self._since.pop(worker, None)
            self._changed.notify_all()

    def _drop(self, worker: WorkerProcess, reason: Loss, detail: str) -> None:
        """A worker is lost: the spare takes its place at once, and another spare is started."""
        worker.kill()
        with self._changed:
            if self._closed:
                return
            if self._active is worker:
                self._active, self._spare = self._spare, None
            elif self._spare is worker:
                self._spare = None
            else:  # seen by two threads
                return
            stands = self._active is not None
            self._changed.notify_all()
        self._tell(reason)
        say("worker", f"{detail}; {'its spare' if stands else 'the next worker'} goes on", logging.ERROR, reason=reason)

    def _keep_a_spare(self) -> None:
        """Look after both until they are closed, whatever happens."""
        while True:
            try:
                self._look_after_both()
                return
            except Exception as error:  # without this thread the next loss would be an outage
                say("worker", f"the workers could not be looked after: {error!r}; it is tried again", logging.ERROR)
                self._wait(_FIRST_RETRY_S)

    def _look_after_both(self) -> None:
        """Start a spare whenever there is none, and notice workers that end or hang while nobody asks them."""
        retry_s, next_ping = _FIRST_RETRY_S, time.monotonic()
        while True:
            with self._changed:
                if not self._closed and self._spare is not None:
                    self._changed.wait(_LOOK_S)
                if self._closed:
                    return
                idle = [worker for worker in self._both() if worker.ended_idle]
                missing, alone = self._spare is None, self._active is None
            for worker in idle:
                self._drop(worker, "crashed", "a worker ended while it had nothing to do")
            if not missing:
                if time.monotonic() >= next_ping:
                    self._check_spare()
                    next_ping = time.monotonic() + _PING_EVERY_S
                continue
            try:
                spare = WorkerProcess(self._bundle, self._settings, self_test=False, polite=not alone)
            except Exception as error:  # whatever it is, without a spare the next loss is an outage
                say("worker", f"no spare worker can be started: {error}; it is tried again", logging.ERROR)
                self._wait(_FIRST_RETRY_S if alone else retry_s)
                retry_s = min(2 * retry_s, _LAST_RETRY_S)
                continue
            retry_s = _FIRST_RETRY_S
            with self._changed:
                closed = self._closed
                if not closed:
                    self._spare = spare
                    self._changed.notify_all()
            if closed:
                spare.kill()

    def _check_spare(self) -> None:
        """A spare that does not listen would be noticed in the worst moment: by the request that needs it."""
        with self._changed:
            spare = self._spare
            if spare is None or spare in self._since:
                return
            self._since[spare] = time.monotonic()
        try:
            spare.ask(PING, None, Deadline(_PING_S))
        except WorkerEnded:
            self._drop(spare, "crashed", "a spare worker ended while it had nothing to do")
        except WorkerLost as loss:
            self._drop(spare, loss.reason, "a spare worker did not listen and was ended")
        finally:
            self._free(spare)

    def _wait(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        with self._changed:
            while not self._closed and (left := until - time.monotonic()) > 0:
                self._changed.wait(left)
