"""docker/attentionvote.service: what systemd itself says of it, and that its filters let the real server work."""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from attentionvote.contract import ModelCard
from attentionvote.inference import load_private_key, write_manifest
from attentionvote.inference.server import serve

if TYPE_CHECKING:
    from conftest import Cell

ROOT = Path(__file__).resolve().parents[2]
UNIT = ROOT / "docker" / "attentionvote.service"
MOST_EXPOSED = 3.0


def settings() -> dict[str, list[str]]:
    """The unit's settings, each with its values in order."""
    text = re.sub(r"\\\n\s*", "", UNIT.read_text(encoding="utf-8"))
    lines = [line for line in text.splitlines() if "=" in line and not line.startswith("#")]
    gathered: dict[str, list[str]] = {}
    for line in lines:
        name, _, value = line.partition("=")
        gathered.setdefault(name, []).append(value)
    return gathered


def program(name: str) -> str:
    """The path of a program; skips without it."""
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"this test needs {name}: install it (Debian: {'systemd' if 'systemd' in name else name})")
    return path


def test_systemd_finds_it_closed() -> None:
    words = [program("systemd-analyze"), "security", "--offline=true", "--no-pager", str(UNIT)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    level = re.search(r"Overall exposure level for attentionvote.service: ([0-9.]+)", done.stdout)
    assert level is not None, done.stdout + done.stderr
    assert float(level[1]) <= MOST_EXPOSED, done.stdout


def test_systemd_reads_every_line_of_it(tmp_path: Path) -> None:
    """A misspelt setting would only be a line in the journal of a cell."""
    analyze = program("systemd-analyze")
    copy = tmp_path / UNIT.name
    text = UNIT.read_text(encoding="utf-8").replace("/opt/attentionvote/bin/attentionvote", sys.executable)
    copy.write_text(text, encoding="utf-8")

    def complaints() -> list[str]:
        done = subprocess.run([analyze, "verify", str(copy)], capture_output=True, text=True, check=False)
        return [line for line in (done.stdout + done.stderr).splitlines() if UNIT.name in line]

    assert complaints() == []
    copy.write_text(text.replace("RestartSec=", "RestartSeconds="), encoding="utf-8")
    assert complaints() != []


def test_it_can_be_enabled_and_comes_back() -> None:
    unit = settings()
    assert unit["WantedBy"] == ["multi-user.target"]
    assert (unit["Restart"], unit["KillMode"]) == (["always"], ["mixed"])
    assert float(unit["RestartSec"][0]) >= 1
    assert unit["StartLimitIntervalSec"] == ["0"]
    # SIGKILL comes only after the server has had its time to answer and to leave its threads.
    assert float(unit["TimeoutStopSec"][0]) > serve._DRAIN_S + serve._THREADS_S


def test_its_command_is_one_that_the_server_takes() -> None:
    unit = settings()
    environment = dict(word.split("=", 1) for value in unit["Environment"] for word in shlex.split(value))
    (command,) = unit["ExecStart"]
    for name, value in environment.items():
        command = command.replace(f"${name}", value)
    words = shlex.split(command)
    assert words[:2] == ["/opt/attentionvote/bin/attentionvote", "serve"]
    parser = argparse.ArgumentParser()
    serve.add_arguments(parser)
    options = parser.parse_args(words[2:])
    assert (options.bundle, options.host) == ("/srv/bundles/latest", "127.0.0.1")
    assert str(options.token_file) == "${CREDENTIALS_DIRECTORY}/token"
    assert str(options.state) == "${STATE_DIRECTORY}"
    assert unit["LoadCredential"] == ["token:/etc/attentionvote/token"]
    assert environment["ATTENTIONVOTE_CACHE"] == "/opt/attentionvote/cache"
    for path in ("/etc/attentionvote/signing.pub", "/etc/attentionvote/cell.env"):
        assert any(path in value for values in unit.values() for value in values)


def system_calls(group: str) -> set[str]:
    """The names in one of systemd's groups."""
    done = subprocess.run(
        [program("systemd-analyze"), "syscall-filter", group], capture_output=True, text=True, check=True
    )
    words = {line.strip() for line in done.stdout.splitlines()[1:] if line.strip() and not line.strip().startswith("#")}
    inner = {word for word in words if word.startswith("@")}
    return (words - inner).union(*map(system_calls, inner))


@pytest.mark.slow
def test_the_real_server_does_only_what_the_filters_allow(cell: Cell, tmp_path: Path, free_port: int) -> None:
    """Traced from its start over requests, a new model and a lost worker to its end."""
    strace, trace = program("strace"), tmp_path / "trace"
    allowed: set[str] = set()
    for value in settings()["SystemCallFilter"]:
        allowed = allowed - system_calls(value[1:]) if value.startswith("~") else allowed | system_calls(value)
    bundles = tmp_path / "bundles"
    shutil.copytree(cell.bundles / "bracket", bundles / "one")
    another_bundle(cell, bundles / "two")
    (bundles / "latest").symlink_to("one")
    server = [sys.executable, "-m", "attentionvote.inference.command_line", "serve", str(bundles / "latest")]
    server += ["--key", str(cell.secrets / "signing.pub"), "--token-file", str(cell.secrets / "token")]
    server += ["--state", str(tmp_path / "state"), "--port", str(free_port), "--poll-s", "0.2", "--threads", "2"]
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen(
            [strace, "-f", "-qq", "-o", str(trace), *server], stdout=log, stderr=log, start_new_session=True
        )
    try:
        cell.wait_ready(free_port, lambda: process.poll() is None)
        cell.check_answers(free_port)
        (bundles / "next").symlink_to("two")
        os.replace(bundles / "next", bundles / "latest")
        digest = hashlib.sha256((bundles / "two" / "manifest.json").read_bytes()).hexdigest()
        until = time.monotonic() + 60
        while f'"digest": "{digest}"' not in (tmp_path / "log").read_text():
            assert time.monotonic() < until, (tmp_path / "log").read_text()
            time.sleep(0.1)
        os.kill(worker_of(process.pid), signal.SIGKILL)
        until = time.monotonic() + 60
        while cell.ask(free_port)[0] != 200:
            assert time.monotonic() < until, (tmp_path / "log").read_text()
            time.sleep(0.1)
    finally:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait(60)
    lines = trace.read_text(encoding="utf-8", errors="replace").splitlines()
    calls = {found[1] for line in lines if (found := re.match(r"\d+ +(?:<\.\.\. )?([a-z_0-9]+)(?:\(| resumed)", line))}
    assert {"memfd_create", "socketpair", "bind", "setpriority", "prlimit64"} <= calls
    assert not calls - allowed
    (families,) = settings()["RestrictAddressFamilies"]
    used = {found[1] for line in lines if (found := re.search(r" socket(?:pair)?\((AF_\w+)", line))}
    assert "AF_INET" in used
    assert used <= set(families.split())
    # MemoryDenyWriteExecute: no memory is both, and none that was written becomes a program.
    maps = [
        line for line in lines if re.search(r" (mmap|mprotect|pkey_mprotect|shmat)\(", line) and "PROT_EXEC" in line
    ]
    assert len(maps) > 10
    assert not [line for line in maps if "PROT_WRITE" in line or "mprotect(" in line]


def another_bundle(cell: Cell, folder: Path) -> None:
    """The cell's bundle with other words in its card, signed again."""
    shutil.copytree(cell.bundles / "bracket", folder)
    card = ModelCard.from_json((folder / "card.json").read_text(encoding="utf-8"))
    (folder / "card.json").write_text(replace(card, evaluation={"ap": 0.8}).to_json(), encoding="utf-8")
    for name in ("manifest.json", "manifest.sig"):
        (folder / name).unlink()
    write_manifest(folder, load_private_key(cell.bundles.parent / "keys" / "signing.key"))


def worker_of(process: int) -> int:
    """A worker below a traced server."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().decode(errors="replace")
            session = os.getsid(int(path.parts[2]))
        except OSError:
            continue
        if session == process and "server.worker.main" in words and "strace" not in words:
            return int(path.parts[2])
    raise AssertionError("no worker runs")
