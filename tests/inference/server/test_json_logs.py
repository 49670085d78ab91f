"""Log lines: one JSON object each, whatever is said."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator

import pytest

from attentionvote.inference.server.json_logs import LOGGER, JsonLines, say


@pytest.fixture
def lines() -> Iterator[list[str]]:
    """What the server's logger wrote."""
    written: list[str] = []

    class Keep(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            written.append(self.format(record))

    handler = Keep()
    handler.setFormatter(JsonLines())
    LOGGER.addHandler(handler)
    level, LOGGER.level = LOGGER.level, logging.INFO
    yield written
    LOGGER.setLevel(level)
    LOGGER.removeHandler(handler)


def test_fields_follow_and_none_is_left_out(lines: list[str]) -> None:
    say("model", 'two\nlines, "quoted" ümlaut', logging.WARNING, part="gear", before=None, path=object)
    (line,) = lines
    content = json.loads(line)
    assert "\n" not in line
    assert content["level"] == "warning"
    assert content["event"] == "model"
    assert content["message"] == 'two\nlines, "quoted" ümlaut'
    assert content["part"] == "gear"
    assert content["path"] == "<class 'object'>"
    assert "before" not in content


def test_a_traceback_is_a_field(lines: list[str]) -> None:
    try:
        raise KeyError("x")
    except KeyError:
        say("error", trace=True)
    content = json.loads(lines[0])
    assert content["traceback"].endswith("KeyError: 'x'")
    assert "message" not in content


def test_other_loggers_are_named(lines: list[str]) -> None:
    record = logging.LogRecord("uvicorn.error", logging.WARNING, "", 0, "Invalid %s", ("request",), None)
    content = json.loads(JsonLines().format(record))
    assert (content["event"], content["message"]) == ("uvicorn.error", "Invalid request")
    assert lines == []
