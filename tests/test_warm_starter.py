"""What a process of the warm starter shares with one that is really started."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import warm_starter

TELL = """
import json, os, sys, tempfile
print(json.dumps({
    "name": __name__, "file": globals().get("__file__"), "words": sys.argv, "path": sys.path[0], "folder": os.getcwd(),
    "parent": os.getppid(), "own session": os.getsid(0) == os.getpid(), "threads": len(os.listdir("/proc/self/task")),
    "descriptors": sorted(int(f) for f in os.listdir("/proc/self/fd") if os.path.exists(f"/proc/self/fd/{f}")),
    "environment": dict(os.environ), "temporary": tempfile.gettempdir(), "pid": os.getpid(),
    "main": sys.modules["__main__"].__dict__ is globals(), "encoding": [sys.stdout.encoding, sys.stderr.errors],
    "ours": sorted(name for name in sys.modules if name.partition(".")[0] == "attentionvote"),
}))
print("said", file=sys.stderr)
print("read", sys.stdin.read(), file=sys.stderr)
"""
pytestmark = pytest.mark.slow  # the starter imports for half a minute on a busy machine


@pytest.fixture(autouse=True)
def environment_of_the_starter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ours is, whatever was set since it was started."""
    started = warm_starter.STARTER.environment
    for name in os.environ.keys() | started.keys():
        if name in started:
            monkeypatch.setenv(name, started[name])
        else:
            monkeypatch.delenv(name)


@pytest.fixture
def script(tmp_path: Path) -> None:
    (tmp_path / "tell.py").write_text(TELL, encoding="utf-8")


def told(start: type[subprocess.Popen[Any]], words: list[str], **settings: Any) -> tuple[dict[str, Any], str]:
    """What the script says of itself and on stderr."""
    pipe = subprocess.PIPE
    with start([sys.executable, *words], stdin=pipe, stdout=pipe, stderr=pipe, text=True, **settings) as process:
        out, err = process.communicate("given", timeout=120)
    assert process.returncode == 0, err
    answer = json.loads(out)
    assert answer.pop("pid") == process.pid
    return answer, err


@pytest.mark.usefixtures("script")
@pytest.mark.parametrize("form", ["script", "-c"])
def test_it_is_what_a_real_start_makes(tmp_path: Path, form: str) -> None:
    (tmp_path / "temporary").mkdir()
    environment = {**os.environ, "ATTENTIONVOTE_X": "ä", "TMPDIR": str(tmp_path / "temporary")}
    words = ["tell.py" if form == "script" else "-c", *([] if form == "script" else [TELL]), "a=1", "b c"]
    with tempfile.TemporaryFile() as file:
        settings = {"cwd": tmp_path, "env": environment, "pass_fds": [file.fileno()], "start_new_session": True}
        real = told(subprocess.Popen, words, **settings)
        warm = told(warm_starter.Popen, words, **settings)
    # A real one has no starter for what it starts.
    assert len(warm[0].pop("descriptors")) == len(real[0].pop("descriptors")) + 1
    assert warm == real
    assert warm[0]["threads"] == 1
    assert warm[0]["parent"] == os.getpid()
    assert warm[1] == "said\nread given\n"


def test_streams_are_inherited_and_the_libraries_are_there(capfd: pytest.CaptureFixture[str]) -> None:
    program = "import sys; print(sorted({'torch', 'mlflow', 'lightning'} & set(sys.modules)))"
    assert warm_starter.run([sys.executable, "-c", program]).returncode == 0
    assert capfd.readouterr().out == "['lightning', 'mlflow', 'torch']\n"


@pytest.mark.parametrize(
    ("program", "code", "last"),
    [
        ("import sys; sys.exit(3)", 3, ""),
        ("import sys; sys.exit('one sentence')", 1, "one sentence"),
        ("raise ValueError('three')", 1, "ValueError: three"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGINT)", -signal.SIGINT, "KeyboardInterrupt"),
        ("import os; os.abort()", -signal.SIGABRT, ""),
        ("import atexit, sys; atexit.register(print, 'late', file=sys.stderr)", 0, "late"),
        ("import threading; threading.Timer(0.2, lambda: 1 / 0).start()", 0, "ZeroDivisionError: division by zero"),
    ],
)  # fmt: skip
def test_it_ends_as_python_ends(program: str, code: int, last: str) -> None:
    for start in (subprocess.run, warm_starter.run):
        done = start([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
        assert done.returncode == code, done.stderr
        assert (done.stderr.splitlines() or [""])[-1] == last
        assert done.stdout == ""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_signals_reach_it_and_its_group(number: signal.Signals) -> None:
    program = "import time; print('ready', flush=True); time.sleep(100)"
    with warm_starter.Popen(
        [sys.executable, "-c", program], stdout=-1, stderr=-1, text=True, start_new_session=True
    ) as process:
        assert process.stdout is not None
        assert process.warm
        assert process.stdout.readline() == "ready\n"
        assert os.getpgid(process.pid) == process.pid
        os.killpg(process.pid, number)
        assert process.wait(30) == -number


def test_the_starter_has_one_thread_and_no_file_but_its_streams_and_its_connection() -> None:
    """What it forks has what is open, and of its threads the one that forks: a pool's would be missed later."""
    for _ in range(2):
        warm_starter.run([sys.executable, "-c", "import torch, mlflow"], check=True)
    process = Path(f"/proc/{warm_starter.STARTER.process_id}")
    assert len(list((process / "task").iterdir())) == 1
    assert len(list((process / "fd").iterdir())) == 4


def test_what_it_starts_is_warm_and_its_own_child() -> None:
    inner = "import os, sys; print(os.getppid(), 'torch' in sys.modules); sys.exit(4)"
    outer = (
        "import os, subprocess, sys\n"
        f"done = subprocess.run([sys.executable, '-c', {inner!r}], capture_output=True, text=True)\n"
        "print(os.getpid(), done.stdout, done.returncode)"
    )
    done = warm_starter.run([sys.executable, "-c", outer], capture_output=True, text=True, check=True)
    outer_pid, parent, libraries, code = done.stdout.split()
    assert parent == outer_pid
    assert (libraries, code) == ("True", "4")


@pytest.fixture
def begun() -> Iterator[list[warm_starter.Popen]]:
    processes: list[warm_starter.Popen] = []
    yield processes
    for process in processes:
        process.kill()
        process.communicate()


@pytest.mark.parametrize(
    ("changes", "settings", "warm"),
    [
        ({}, {}, True),
        ({"MLFLOW_TRACKING_URI": "sqlite:///x"}, {}, True),
        ({"OMP_NUM_THREADS": "2"}, {}, False),
        ({"PYTHONPATH": "/elsewhere"}, {}, False),
        ({}, {"env": {}}, False),
        ({}, {"preexec_fn": os.getpid}, False),
        ({}, {"process_group": 0}, False),
    ],
)
def test_what_a_fork_would_not_be_is_a_real_start(
    begun: list[warm_starter.Popen], changes: dict[str, str], settings: dict[str, Any], warm: bool
) -> None:
    settings = {"env": {**os.environ, **changes}, **settings}
    process = warm_starter.Popen([sys.executable, "-c", "import time; time.sleep(100)"], **settings)
    begun.append(process)
    assert process.warm == warm


def test_a_program_that_is_no_python_is_a_real_start() -> None:
    with warm_starter.Popen(["true"]) as process:
        assert process.wait(30) == 0
        assert not process.warm
