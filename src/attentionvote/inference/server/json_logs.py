"""Structured logs: one JSON object a line on stderr. No cloud contents, no headers, no query strings, no secrets."""

from __future__ import annotations

import datetime
import json
import logging
import sys
import threading
from typing import Any

from attentionvote.inference.server.log_writer import LogWriter

LOGGER = logging.getLogger("attentionvote.server")


class JsonLines(logging.Formatter):
    """A log record as one line of JSON: time, level, event, message, and the fields given with it."""

    def format(self, record: logging.LogRecord) -> str:
        moment = datetime.datetime.fromtimestamp(record.created, datetime.UTC)
        line: dict[str, Any] = {
            "time": moment.isoformat(timespec="milliseconds").replace("+00:00", "Z"),
            "level": record.levelname.lower(),
            "event": getattr(record, "event", record.name),
        }
        message = record.getMessage()
        if message:
            line["message"] = message
        line |= getattr(record, "fields", {})
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False, default=str)


def configure() -> LogWriter:
    """Send every logger of the process through :class:`JsonLines` to stderr; libraries from warnings on."""
    writer = LogWriter(sys.stderr.fileno())
    writer.setFormatter(JsonLines())
    logging.basicConfig(level=logging.WARNING, handlers=[writer], force=True)
    LOGGER.setLevel(logging.INFO)
    logging.captureWarnings(True)
    # What Python itself writes to stderr about a thread would wait for the reader of a full pipe.
    threading.excepthook = _thread_failed
    return writer


def _thread_failed(failure: threading.ExceptHookArgs) -> None:
    name = failure.thread.name if failure.thread is not None else "unknown"
    trace = None
    if failure.exc_value is not None:
        trace = (failure.exc_type, failure.exc_value, failure.exc_traceback)
    LOGGER.error("the thread %s ended in an unforeseen way", name, exc_info=trace, extra={"event": "error"})


def say(event: str, message: str = "", level: int = logging.INFO, *, trace: bool = False, **fields: Any) -> None:
    """Write one line.

    Args:
        event: what happened, one word or two with an underscore: what a log search asks for.
        message: one sentence for people.
        level: of :mod:`logging`.
        trace: add the traceback of the exception that is being handled.
        fields: further values of the line; None is left out.
    """
    present = {name: value for name, value in fields.items() if value is not None}
    LOGGER.log(level, message, exc_info=trace, extra={"event": event, "fields": present})
