"""The thread that writes the log: whoever logs never waits for the reader of a pipe."""

from __future__ import annotations

import logging
import os
import queue
import threading
import time
from collections.abc import Callable

_MOST_LINES, _MOST_LINE_CHARACTERS = 2000, 16_384
_FLUSH_S = 0.5
_RETRY_S = 0.05


class LogWriter(logging.Handler):
    """Writes formatted records to a file handle from a bounded queue. A full queue drops lines and counts them.

    Args:
        handle: of the file; a blocking pipe as a rule.

    Attributes:
        dropped: told for every line that is dropped.
    """

    def __init__(self, handle: int) -> None:
        super().__init__()
        self.dropped: Callable[[], None] = lambda: None
        self._handle = handle
        self._lines: queue.Queue[str] = queue.Queue(_MOST_LINES)
        self._lost = 0  # not yet reported; changed under the handler's own lock
        threading.Thread(target=self._write_lines, name="log", daemon=True).start()

    def emit(self, record: logging.LogRecord) -> None:
        """Queue a record's line."""
        try:
            self._lines.put_nowait(self.format(record)[:_MOST_LINE_CHARACTERS])
        except Exception:  # the queue is full, or a field cannot be printed: logging itself would write to the pipe
            self._lost += 1
            self.dropped()

    def flush(self) -> None:
        """Wait until all lines are written, half a second at most."""
        until = time.monotonic() + _FLUSH_S
        while self._lines.unfinished_tasks and time.monotonic() < until:
            time.sleep(0.005)

    def _write_lines(self) -> None:
        while True:
            line = self._lines.get()
            self._write(line)
            self._report_lost()
            self._lines.task_done()

    def _report_lost(self) -> None:
        """Say how many lines are missing, as soon as one could be written again."""
        if not self._lost:
            return
        with self.lock if self.lock is not None else threading.RLock():
            lost, self._lost = self._lost, 0
        message = f"{lost} lines were dropped here: nobody read the log in time"
        record = logging.LogRecord("attentionvote.server", logging.WARNING, "", 0, message, (), None)
        record.event, record.fields = "log", {"dropped": lost}
        self._write(self.format(record))

    def _write(self, line: str) -> None:
        rest = memoryview(f"{line}\n".encode(errors="replace"))
        while len(rest):
            try:
                rest = rest[os.write(self._handle, rest) :]
            except BlockingIOError:
                time.sleep(_RETRY_S)
            except OSError:  # the reader has gone, or the disk is full: there is nobody to tell
                return
