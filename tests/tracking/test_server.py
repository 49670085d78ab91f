"""A real MLflow server on the loopback interface: what `make ui` starts, and what a team logs to."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

from attentionvote.tracking.run_opening import start_run
from attentionvote.tracking.server import serve
from attentionvote.tracking.store import connect


@pytest.mark.slow
def test_run_on_a_server_with_artefacts_an_outage_and_a_resume(put_tables, tmp_path, caplog, capfd):
    store = put_tables(tmp_path / "mlflow.db")
    checkpoint = tmp_path / "last.ckpt"
    checkpoint.write_bytes(b"weights" * 1000)
    with serve(store) as server:
        port = int(server.url.rsplit(":", 1)[1])
        run = start_run(server.url, "rod", params={"lr": 1}, config_yaml="lr: 1", system_interval_s=0)
        run.log_metrics({"train/loss": 1.0}, 0)
        run.log_file("checkpoints/last.ckpt", checkpoint)
        assert run.flush(60)
        assert run.download("checkpoints/last.ckpt", tmp_path / "out").read_bytes() == checkpoint.read_bytes()
        assert run.url_hint == f"{server.url}/#/experiments/{run.experiment_id}/runs/{run.id}"
        assert b"MLflow" in urllib.request.urlopen(server.url, timeout=10).read()
    # The server is away: training goes on, with one warning of each kind.
    run.log_metrics({"train/loss": 2.0}, 1)
    checkpoint.write_bytes(b"newer")
    run.log_file("checkpoints/last.ckpt", checkpoint)
    assert not run.flush(8)
    assert caplog.text.count("metrics wait in memory") == 1
    with serve(store, port):
        assert run.flush(60)
        assert run.metric_history("train/loss") == ([0, 1], [1.0, 2.0])
        assert run.download("checkpoints/last.ckpt", tmp_path / "new").read_bytes() == b"newer"
        run.close("FAILED")
        with start_run(server.url, run_id=run.id, params={"lr": 1}, system_interval_s=0) as again:
            again.log_metrics({"train/loss": 3.0}, 2)
    stored = connect(store).get_run(run.id)
    assert stored.info.status == "FINISHED"
    assert stored.data.metrics == {"train/loss": 3.0}
    assert capfd.readouterr().out == ""  # MLflow likes to print addresses where a verb prints its result


def test_serve_refuses_a_server():
    with (
        pytest.raises(ValueError, match="only a local store needs a server, got http://tracking:5000"),
        serve("http://tracking:5000"),
    ):
        pass


@pytest.mark.slow
def test_ui_prints_one_json_line_without_the_password_and_ends_on_interrupt(repository, guarded):
    command = [sys.executable, str(repository / "pipelines/ui.py")]
    environment = {**os.environ, "MLFLOW_TRACKING_URI": guarded}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment) as ui:
        assert ui.stdout is not None
        line = ui.stdout.readline()
        answer = json.loads(line)
        assert answer["store"] == guarded.replace("swordfish%2F7", "***")
        with urllib.request.urlopen(answer["url"] + "/health", timeout=10) as reply:
            assert reply.read() == b"OK"
        commands = [_command_line(path) for path in Path("/proc").glob("[0-9]*")]  # what `ps` shows to everybody
        assert any("mlflow" in words and answer["url"].rpartition(":")[2] in words for words in commands)
        assert not [words for words in commands if "swordfish" in words]
        ui.send_signal(signal.SIGINT)
        rest, said = ui.communicate(timeout=30)
    assert ui.returncode == 0
    assert rest == ""
    assert "swordfish" not in line + said
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(answer["url"] + "/health", timeout=5)


@pytest.fixture
def make_ui(repository, put_tables, tmp_path):
    """Starts the script or `make ui` on a store, waits for its answer; process, address and store.

    The Makefile's set-up is taken as done, with the Python that runs the tests.
    """
    store = put_tables(tmp_path / "mlflow.db")
    environment = {**os.environ, "MLFLOW_TRACKING_URI": store}
    processes = []

    def start(by_make):
        words = [sys.executable, str(repository / "pipelines/ui.py")]
        if by_make:
            words = ["make", "-s", "-C", str(repository), "ui", f"PY={sys.executable}", "STAMP=pyproject.toml"]
        processes.append(
            subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment)
        )
        url = json.loads(processes[-1].stdout.readline())["url"]
        return processes[-1], url, store.removeprefix("sqlite:///")

    yield start
    for process in processes:
        process.kill()
        process.wait(30)
        process.stdout.close()


def holders(file):
    """Process numbers of those who have a file open."""
    numbers = set()
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        with contextlib.suppress(OSError):
            if os.readlink(link).startswith(str(file)):
                numbers.add(int(link.parts[2]))
    return numbers


@pytest.mark.slow
@pytest.mark.parametrize(
    ("by_make", "number"), [(False, signal.SIGTERM), (False, signal.SIGKILL), (True, signal.SIGTERM)]
)
def test_kill_of_the_starter_ends_the_server_and_its_hold_on_the_database(make_ui, by_make, number):
    process, url, database = make_ui(by_make)
    port = url.rpartition(":")[2]

    def server_processes():
        return [line for path in Path("/proc").glob("[0-9]*") if f"--port\0{port}" in (line := _command_line(path))]

    with urllib.request.urlopen(url + "/health", timeout=10) as reply:
        assert reply.read() == b"OK"
    assert server_processes()
    process.send_signal(number)
    process.wait(30)
    until = time.monotonic() + 20
    while server_processes() or holders(database):
        assert time.monotonic() < until, (server_processes(), holders(database))
        time.sleep(0.1)
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(url + "/health", timeout=5)
    if not by_make and number == signal.SIGTERM:
        assert process.returncode == 0


def _command_line(process):
    """The words that a process was started with; nothing when it has just ended."""
    try:
        return (process / "cmdline").read_bytes().decode(errors="replace")
    except OSError:
        return ""


def test_ui_rejects_an_impossible_store_in_one_sentence(repository):
    command = [sys.executable, str(repository / "pipelines/ui.py"), "--store", "file:./mlruns"]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 2
    assert result.stdout == ""
    assert len(result.stderr.strip().splitlines()) == 1
    assert "sqlite:///outputs/mlflow.db" in result.stderr
