"""Metrics are queued by the training loop and written in batches by a background thread."""

from __future__ import annotations

import logging
import re
import threading
import time
from collections import deque
from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mlflow import MlflowClient

log = logging.getLogger(__name__)

BATCH = 1000  # MLflow's limit for one request
# Series whose values belong to a moment, not to a step of training: a resumed run may write their steps again.
UNORDERED = ("test/", "system/")


def metric_name(name: str) -> str:
    """The name with every character replaced that MLflow refuses or Lightning's users trip over (``@``)."""
    return re.sub(r"[^\w\-./: ]", "_", name)


class MetricWriter:
    """Queue of metrics with a writer thread; a store that is away costs memory and one warning, never training.

    Args:
        client: of the store.
        run_id: the run.
        last_steps: per metric the last step already stored. A resumed training repeats the steps since its
            checkpoint; those are skipped, so that each series stays one contiguous line.
        interval_s: longest time a metric waits.
        capacity: metrics kept while the store is away; the oldest are dropped beyond.
    """

    def __init__(
        self,
        client: MlflowClient,
        run_id: str,
        last_steps: Mapping[str, int] | None = None,
        interval_s: float = 5.0,
        capacity: int = 500_000,
    ) -> None:
        self._client, self._run_id = client, run_id
        self._last_steps = dict(last_steps or {})
        self._interval_s = interval_s
        self._queue: deque[tuple[str, float, int, int]] = deque(maxlen=capacity)
        self._changed = threading.Condition()
        self._hurry = self._stop = self._writing = self._failing = False
        self._thread = threading.Thread(target=self._write_forever, name="metric-writer", daemon=True)
        self._thread.start()

    def add(self, metrics: Mapping[str, float], step: int) -> None:
        """Queue values (anything ``float()`` takes) of one step; returns at once."""
        now = int(time.time() * 1000)
        rows = []
        for name, value in metrics.items():
            name = metric_name(name)
            if step > self._last_steps.get(name, step - 1) or name.startswith(UNORDERED):
                rows.append((name, float(value), now, step))
        with self._changed:
            self._queue.extend(rows)
            if len(self._queue) >= BATCH:
                self._changed.notify_all()

    def last_step(self, name: str) -> int:
        """Last step that the store had of a metric when the run was opened, -1 for none."""
        return self._last_steps.get(name, -1)

    def flush(self, timeout_s: float) -> bool:
        """Write everything queued; False when that did not succeed within the time."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while self._queue or self._writing:
                self._hurry = True
                self._changed.notify_all()
                left = deadline - time.monotonic()
                if left <= 0 or not self._thread.is_alive():
                    return False
                self._changed.wait(min(left, 0.2))
        return True

    def close(self, timeout_s: float) -> int:
        """Write what is left and stop the thread; returns the number of metrics that could not be written."""
        self.flush(timeout_s)
        with self._changed:
            self._stop = True
            self._changed.notify_all()
        self._thread.join(timeout=1.0)
        return len(self._queue)

    def _write_forever(self) -> None:
        pause_s = self._interval_s
        while True:
            with self._changed:
                if not self._hurry and not self._stop and len(self._queue) < BATCH:
                    self._changed.wait(pause_s)
                if self._stop:
                    return
                self._hurry = False
                batch = [self._queue.popleft() for _ in range(min(BATCH, len(self._queue)))]
                self._writing = bool(batch)
            if not batch:
                continue
            written = self._write(batch)
            with self._changed:
                if not written:
                    room = (self._queue.maxlen or 0) - len(self._queue)
                    self._queue.extendleft(reversed(batch[max(0, len(batch) - room) :]))
                self._writing = False
                self._changed.notify_all()
                if not written and not self._stop:
                    self._hurry = False
                    self._changed.wait(min(pause_s, 1.0))
            pause_s = self._interval_s if written else min(2 * pause_s, 60.0)

    def _write(self, batch: list[tuple[str, float, int, int]]) -> bool:
        from mlflow.entities import Metric

        try:
            self._client.log_batch(self._run_id, metrics=[Metric(*row) for row in batch])
        except Exception as error:  # whatever is wrong with the store, training goes on
            if not self._failing:
                log.warning("metrics wait in memory, the tracking store fails: %s", str(error).strip().split("\n")[0])
            self._failing = True
            return False
        if self._failing:
            log.warning("the tracking store works again, metrics are being caught up")
        self._failing = False
        return True
