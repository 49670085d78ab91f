"""The store: which URI, and several processes on a fresh database at once."""

import os
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

from attentionvote.tracking.server import free_port
from attentionvote.tracking.store import artifact_root, connect, experiment_id, resolve_store


def test_resolve_store_prefers_the_argument_then_the_environment_then_outputs(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://tracking:5000/")
    assert resolve_store("sqlite:///a/b.db") == f"sqlite:///{tmp_path}/a/b.db"
    assert resolve_store("a/b.db") == f"sqlite:///{tmp_path}/a/b.db"
    assert resolve_store(None) == "http://tracking:5000"
    monkeypatch.delenv("MLFLOW_TRACKING_URI")
    assert resolve_store(None) == f"sqlite:///{tmp_path}/outputs/mlflow.db"
    assert artifact_root(resolve_store(None)) == tmp_path / "outputs/mlartifacts"
    assert artifact_root("https://tracking") is None


@pytest.mark.parametrize(
    ("store", "sentence"),
    [
        ("file:///tmp/mlruns", "must be an SQLite file or a server.*nearest: 'sqlite:///outputs/mlflow.db'"),
        ("mlruns", "must be an SQLite file or a server"),
        ("sqlit:///x.db", "got 'sqlit:///x.db', nearest: 'sqlite://'"),
        ("htps://server", "nearest: 'https://'"),
        ("sqlite://x.db", "must read sqlite:///PATH.db"),
    ],
)
def test_resolve_store_rejects_with_the_nearest_choice(store, sentence):
    with pytest.raises(ValueError, match=sentence):
        resolve_store(store)


def test_connect_names_a_server_that_is_away():
    with pytest.raises(ConnectionError, match=r"must answer, got: .*refused.*unset MLFLOW_TRACKING_URI"):
        connect(f"http://127.0.0.1:{free_port()}")


def test_connect_rejects_a_file_that_is_no_database(tmp_path):
    path = tmp_path / "mlflow.db"
    path.write_text("not a database, but long enough to have a header" * 100)
    with pytest.raises(ValueError, match=r"cannot be opened: .*not a database"):
        connect(f"sqlite:///{path}")


def test_deleted_experiment_comes_back(tmp_path):
    uri = resolve_store(str(tmp_path / "mlflow.db"))
    client = connect(uri)
    first = experiment_id(client, uri, "rod")
    client.delete_experiment(first)
    assert experiment_id(client, uri, "rod") == first
    assert client.get_experiment(first).lifecycle_stage == "active"
    assert client.get_experiment(first).artifact_location == (tmp_path / "mlartifacts").as_uri()


def test_importing_the_package_imports_neither_mlflow_nor_lightning():
    code = (
        "import sys, attentionvote.tracking; print([m for m in ('mlflow', 'lightning', 'torch') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


@pytest.mark.slow
def test_processes_may_open_a_fresh_database_at_once(tmp_path):
    uri = f"sqlite:///{tmp_path}/new/mlflow.db"
    code = (
        "import sys; from attentionvote.tracking import start_run\n"
        "run = start_run(sys.argv[1], 'rod', system_interval_s=0); run.log_metrics({'x': 1}, 0); run.close()"
    )
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    processes = [
        subprocess.Popen([sys.executable, "-c", code, uri], stderr=subprocess.PIPE, text=True, env=environment)
        for _ in range(3)
    ]
    errors = [process.communicate(timeout=120)[1] for process in processes]
    assert [process.returncode for process in processes] == [0, 0, 0], errors
    with sqlite3.connect(Path(tmp_path, "new/mlflow.db")) as database:
        rows = database.execute("select status, count(*) from runs group by status").fetchall()
        experiments = database.execute("select count(*) from experiments where name = 'rod'").fetchone()
    database.close()
    assert rows == [("FINISHED", 3)]
    assert experiments == (1,)
