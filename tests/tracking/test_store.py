"""The store: which URI, no password in what is said, and several processes on a fresh database at once."""

import contextlib
import subprocess
import sys
import threading
import traceback
from collections import Counter

import pytest
import warm_starter
from real_disks import resize, small_disk

from attentionvote.files import DiskFull
from attentionvote.tracking.run_opening import start_run
from attentionvote.tracking.server import free_port
from attentionvote.tracking.sqlite_file import sqlite_file
from attentionvote.tracking.store import (
    artifact_root,
    connect,
    exclusive,
    experiment_id,
    has_password,
    resolve_store,
    shown,
)


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
    # psycopg2 is what is installed; SQLAlchemy would look for another driver.
    assert resolve_store("postgresql://me@db/mlflow") == "postgresql+psycopg2://me@db/mlflow"
    assert resolve_store("postgresql+psycopg://me@db/mlflow") == "postgresql+psycopg://me@db/mlflow"
    assert artifact_root(resolve_store("postgresql://me@db/mlflow")) == tmp_path / "outputs/mlartifacts"


@pytest.mark.parametrize(
    ("store", "sentence"),
    [
        ("file:///tmp/mlruns", "must be an SQLite file or a server.*nearest: 'sqlite:///outputs/mlflow.db'"),
        ("mlruns", "must be an SQLite file or a server"),
        ("sqlit:///x.db", "got 'sqlit:///x.db', nearest: 'sqlite://'"),
        ("htps://server", "nearest: 'https://'"),
        ("sqlite://x.db", "must read sqlite:///PATH.db"),
        ("postgres://me:secret@db/x", r"got 'postgres://me:\*\*\*@db/x', nearest: 'postgresql://'"),
        ("postgresql://me:secr@t@db/x", r"percent-encoded \(@ is %40\), got 'postgresql://me:\*\*\*@db/x'"),
        (
            "https://me:secret@server:5000/",
            r"must not hold user and password, got 'https://\*\*\*@server:5000/': set ",
        ),
    ],
)
def test_resolve_store_rejects_with_the_nearest_choice(store, sentence):
    with pytest.raises(ValueError, match=sentence):
        resolve_store(store)


@pytest.mark.parametrize("name", ["x%20y", "a?b #c 100%", "é ;'@ 日本"])
def test_a_store_lies_in_its_folder_whatever_that_is_called(name, tmp_path, monkeypatch):
    folder = tmp_path / name
    folder.mkdir()
    monkeypatch.chdir(folder)
    uri = resolve_store(None)
    assert resolve_store(uri) == uri
    assert sqlite_file(uri) == folder / "outputs/mlflow.db"
    run = start_run(None, "rod", system_interval_s=0, repository=tmp_path)
    run.log_text("notes/a.txt", name)
    assert run.download("notes/a.txt", tmp_path / "fetched").read_text() == name
    run.close()
    assert [file.read_text() for file in (folder / "outputs/mlartifacts").rglob("a.txt")] == [name]
    model = connect(uri).create_logged_model(run.experiment_id, name="m")
    connect(uri).log_model_artifacts(model.model_id, str(tmp_path / "fetched"))
    assert (folder / "outputs/mlartifacts/models" / model.model_id / "artifacts/a.txt").is_file()
    assert {path.name for path in tmp_path.iterdir()} == {name, "fetched"}


def test_an_address_that_would_be_the_neighbour_s_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in ("x%20y", "x y"):
        (tmp_path / folder).mkdir()
    with pytest.raises(ValueError, match=r"must be percent-encoded .*nearest: 'sqlite:///.*/x%2520y/m.db'"):
        resolve_store(f"sqlite:///{tmp_path}/x%20y/m.db")
    with pytest.raises(ValueError, match=r"must be percent-encoded .*nearest: 'sqlite:///.*/a%3Fb/m.db'"):
        resolve_store("sqlite:///a?b/m.db")
    assert sqlite_file(resolve_store("x%20y/m.db")) == tmp_path / "x%20y/m.db"
    assert sqlite_file(resolve_store("sqlite:///x y/m.db")) == tmp_path / "x y/m.db"
    (tmp_path / "x%20y").rmdir()
    assert sqlite_file(resolve_store("sqlite:///x%20y/m.db")) == tmp_path / "x y/m.db"


@pytest.mark.parametrize(
    ("store", "said"),
    [
        ("postgresql://me:p:a/s?s#@db:5432/x?sslmode=require", "postgresql://me:***@db:5432/x?sslmode=require"),
        ("postgresql://me@/x?host=/run&password=p&sslpassword=q", "postgresql://me@/x?host=/run&password=***&sslpassword=***"),
        ("postgresql://me@db:5432/x", "postgresql://me@db:5432/x"),
        ("sqlite:////data/mlflow.db", "sqlite:////data/mlflow.db"),
        ("http://127.0.0.1:5000", "http://127.0.0.1:5000"),
        ("https://token@host", "https://***@host"),
        ("https://me:p@host:5000/mlflow", "https://***@host:5000/mlflow"),
        ("https://host/a@b", "https://host/a@b"),
    ],
)  # fmt: skip
def test_shown_hides_passwords_and_nothing_else(store, said):
    assert shown(store) == said
    assert has_password(store) == ("***" in said)


def test_what_goes_wrong_is_one_sentence_without_the_password(guarded, caplog, capfd):
    client = connect(guarded)
    experiment = experiment_id(client, guarded, "rod")
    assert client.get_experiment(experiment).name == "rod"
    wrong = {
        guarded.replace(
            "swordfish", "sword%2Ffish"
        ): "cannot be opened: .*password authentication failed for .*guarded",
        guarded.replace("/test_", "/no_test_"): "cannot be opened: .*database .* does not exist",
        guarded.replace("?host=", "?host=/nowhere"): "cannot be opened: .*No such file or directory",
        guarded.replace("?host=", "?port=none&host="): "cannot be opened: .*port",
    }
    said = []
    for uri, sentence in wrong.items():
        with pytest.raises(ValueError, match=sentence) as caught:
            connect(uri)
        assert "guarded:***@" in str(caught.value)
        assert len(str(caught.value).splitlines()) == 1
        said += traceback.format_exception(caught.value)  # what goes to outputs/logs
    with pytest.raises(ValueError, match=r"run_id must name a run in .*guarded:\*\*\*@") as unknown:
        start_run(guarded, "rod", run_id="nothing")
    said += [*traceback.format_exception(unknown.value), caplog.text, *capfd.readouterr()]
    assert not [text for text in said for secret in ("swordfish", "sword/fish", "sword%2F") if secret in text]


def test_connect_names_a_server_that_is_away():
    with pytest.raises(ConnectionError, match=r"must answer, got: .*refused.*unset MLFLOW_TRACKING_URI"):
        connect(f"http://127.0.0.1:{free_port()}")


def test_connect_rejects_a_file_that_is_no_database(tmp_path):
    path = tmp_path / "mlflow.db"
    path.write_text("not a database, but long enough to have a header" * 100)
    with pytest.raises(ValueError, match=r"cannot be opened: .*not a database"):
        connect(f"sqlite:///{path}")


def test_deleted_experiment_comes_back(database, tmp_path):
    client = connect(database)
    first = experiment_id(client, database, "rod")
    assert client.get_experiment(first).tags["mlflow.experimentKind"] == "custom_model_development"
    client.delete_experiment_tag(first, "mlflow.experimentKind")  # of an earlier version
    client.delete_experiment(first)
    assert experiment_id(client, database, "rod") == first
    assert client.get_experiment(first).lifecycle_stage == "active"
    assert client.get_experiment(first).tags["mlflow.experimentKind"] == "custom_model_development"
    folder = tmp_path / ("mlartifacts" if database.startswith("sqlite") else "outputs/mlartifacts")
    assert client.get_experiment(first).artifact_location == folder.as_uri()


def test_importing_the_package_imports_neither_mlflow_nor_lightning():
    code = (
        "import sys, attentionvote.tracking; print([m for m in ('mlflow', 'lightning', 'torch') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_exclusive_lets_one_in_at_a_time_and_the_next_after_a_kill(kind, request, tmp_path):
    uri = f"sqlite:///{tmp_path}/x.db" if kind == "sqlite" else request.getfixturevalue("postgresql").uri("postgres")
    code = (
        "import sys; from attentionvote.tracking.store import exclusive\n"
        "with exclusive(sys.argv[1]): print('in', flush=True); sys.stdin.readline()"
    )
    with subprocess.Popen([sys.executable, "-c", code, uri], stdin=-1, stdout=-1, text=True) as holder:
        assert holder.stdout.readline() == "in\n"
        entered = threading.Event()

        def enter():
            with exclusive(uri):
                entered.set()

        waiting = threading.Thread(target=enter)
        waiting.start()
        assert not entered.wait(0.5)
        holder.kill()
        waiting.join(timeout=30)
        assert entered.is_set()


# MLflow holds one machine's processes apart by a file below the temporary folder: here each is a machine of its own.
RACE = """
import os, sys, tempfile, warnings
warnings.simplefilter("ignore")
from attentionvote.files import DiskFull
from attentionvote.tracking.run_opening import start_run
from attentionvote.tracking.store import quiet_environment
quiet_environment()
import mlflow.store.tracking.sqlalchemy_store, mlflow.server.handlers
go = os.pipe()
children = []
for number in range(4):
    child = os.fork()
    if child == 0:
        tempfile.tempdir = os.path.abspath(f"machine_{number}")
        os.mkdir(tempfile.tempdir)
        os.close(go[1])
        os.read(go[0], 1)  # all start together, when the writing end is closed
        status = 1
        try:
            run = start_run(sys.argv[1], "rod", system_interval_s=0)
            run.log_metrics({"x": number}, 0)
            run.close()
            status = 0
        except BaseException as error:
            print(type(error).__name__, error, file=sys.stderr, flush=True)
        os._exit(status)
    children.append(child)
os.close(go[1])
print([os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children])
"""


@pytest.mark.slow
def test_processes_may_open_a_fresh_database_at_once(empty_database):
    done = warm_starter.run(
        [sys.executable, "-c", RACE, empty_database], capture_output=True, text=True, timeout=200, check=False
    )
    assert done.stdout.strip() == "[0, 0, 0, 0]", done.stderr
    client = connect(empty_database)
    (experiment,) = [found for found in client.search_experiments() if found.name == "rod"]
    runs = client.search_runs([experiment.experiment_id])
    assert Counter(run.info.status for run in runs) == {"FINISHED": 4}
    assert sorted(run.data.metrics["x"] for run in runs) == [0, 1, 2, 3]


def test_a_full_disk_leaves_no_half_database(tmp_path):
    with small_disk(tmp_path / "disk", "400k") as disk:
        uri = f"sqlite:///{disk}/mlflow.db"
        with pytest.raises(DiskFull, match=rf"^the disk of {disk} must have room, but [\d,]+ bytes are free"):
            connect(uri)
        assert [path.name for path in disk.iterdir()] == ["mlflow.db.lock"]
        (disk / ".mlflow.1.db").touch()  # of a killed process
        (disk / ".mlflow.1.db-journal").touch()
        resize(disk, "8m")
        client = connect(uri)
        assert sorted(path.name for path in disk.iterdir()) == ["mlflow.db", "mlflow.db.lock"]
        with (disk / "rest").open("wb", buffering=0) as rest, contextlib.suppress(OSError):
            while rest.write(b"x" * 4096):
                pass
        with pytest.raises(DiskFull, match=rf"^the disk of {disk} must have room"):
            experiment_id(client, uri, "rod")
        (disk / "rest").unlink()
        assert experiment_id(client, uri, "rod")
