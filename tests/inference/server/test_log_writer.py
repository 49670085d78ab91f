"""The log's thread: a pipe that nobody reads stops nobody, and says afterwards what is missing."""

from __future__ import annotations

import http.client
import json
import logging
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from attentionvote.inference.server.json_logs import JsonLines
from attentionvote.inference.server.log_writer import LogWriter


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    """Both ends."""
    reading, writing = os.pipe()
    yield reading, writing
    for handle in (reading, writing):
        with suppress(OSError):
            os.close(handle)


def writer_to(handle: int) -> LogWriter:
    writer = LogWriter(handle)
    writer.setFormatter(JsonLines())
    return writer


def record(message: str) -> logging.LogRecord:
    return logging.LogRecord("cell", logging.INFO, "", 0, message, (), None)


def lines_from(handle: int, until: str) -> list[dict[str, Any]]:
    """The lines up to the one that holds a text."""
    content = b""
    while until.encode() not in content or not content.endswith(b"\n"):
        content += os.read(handle, 65536)
    return [json.loads(line) for line in content.splitlines()]


def test_lines_arrive_in_order(pipe: tuple[int, int]) -> None:
    reading, writing = pipe
    writer = writer_to(writing)
    for i in range(100):
        writer.handle(record(f"line {i}"))
    writer.flush()
    assert [line["message"] for line in lines_from(reading, "line 99")] == [f"line {i}" for i in range(100)]


def test_a_full_pipe_drops_lines_counts_them_and_says_so(pipe: tuple[int, int]) -> None:
    reading, writing = pipe
    writer = writer_to(writing)
    dropped: list[None] = []
    writer.dropped = lambda: dropped.append(None)
    begun = time.monotonic()
    for i in range(5000):
        writer.handle(record(f"line {i} {'x' * 100}"))
    writer.flush()
    assert time.monotonic() - begun < 5
    assert 1000 < len(dropped) < 3000
    lines: list[dict[str, Any]] = []
    content = b""
    while len(lines) < 5000 - len(dropped) or sum(line.get("dropped", 0) for line in lines) < len(dropped):
        content += os.read(reading, 65536)
        *whole, content = content.split(b"\n")
        lines += map(json.loads, whole)
    reports = [line for line in lines if "dropped" in line]
    assert sum(line["dropped"] for line in reports) == len(dropped)
    count = reports[-1]["dropped"]
    assert reports[-1]["message"] == f"{count} lines were dropped here: nobody read the log in time"
    assert reports[-1]["level"] == "warning"
    assert len(lines) == 5000 - len(dropped) + len(reports)
    writer.handle(record("the last"))
    assert lines_from(reading, "the last")[-1]["message"] == "the last"


def test_a_reader_that_has_gone_is_nobody_s_problem(pipe: tuple[int, int]) -> None:
    reading, writing = pipe
    os.close(reading)
    writer = writer_to(writing)
    for i in range(10):
        writer.handle(record(f"line {i}"))
    begun = time.monotonic()
    writer.flush()
    assert time.monotonic() - begun < 0.4


def test_a_field_that_cannot_be_printed_costs_its_line_only(pipe: tuple[int, int]) -> None:
    class Broken:
        def __str__(self) -> str:
            raise ValueError("no text")

    writer = writer_to(pipe[1])
    bad = record("bad")
    bad.fields = {"x": Broken()}
    writer.handle(bad)
    writer.handle(record("good"))
    messages = [line["message"] for line in lines_from(pipe[0], "dropped here")]
    assert messages[0] == "good"
    assert messages[1].startswith("1 lines were dropped here")


def test_a_server_whose_log_nobody_reads_goes_on_and_ends(
    bundle_folder: Path, trusted_key: Path, tmp_path: Path
) -> None:
    words = [sys.executable, "-m", "attentionvote.inference.command_line", "serve", str(bundle_folder), "--port", "0"]
    words += ["--key", str(trusted_key), "--state", str(tmp_path / "state")]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        address = json.loads(process.stdout.readline())["url"].partition("//")[2]
        connection = http.client.HTTPConnection(address, timeout=10)
        for _ in range(2600):  # frozen after 200 of them, when a request wrote its own line
            connection.request("GET", "/nowhere")
            reply = connection.getresponse()
            assert (reply.status, reply.read()[:8]) == (404, b'{"error"')
        connection.close()
        process.terminate()
        assert process.wait(9) == 0
        lines = process.stderr.read().splitlines()
        assert json.loads(lines[0])["event"] == "start"


def test_a_thread_that_fails_is_a_line_of_the_log() -> None:
    program = """
import threading
from attentionvote.inference.server.json_logs import configure
configure()
thread = threading.Thread(target=lambda: 1 / 0, name="divider")
thread.start()
thread.join()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=30, check=False)
    (line,) = map(json.loads, done.stderr.splitlines())
    assert line["message"] == "the thread divider ended in an unforeseen way"
    assert line["traceback"].endswith("ZeroDivisionError: division by zero")
