"""A real MLflow server with users: who comes in, what verbs say without a password, what a cell's user may do."""

import base64
import json
import logging
import os
import secrets
import subprocess
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from dataclasses import dataclass
from pathlib import Path

import pytest
import train

from attentionvote.command.configuration import compose
from attentionvote.tracking.run_opening import start_run
from attentionvote.tracking.server import free_port
from attentionvote.tracking.store import connect, experiment_id
from attentionvote.workflows.train.settings import TrainSettings

pytestmark = pytest.mark.slow
MODEL = "attentionvote-bracket"


@dataclass(frozen=True)
class Guarded:
    """The server: its address, the folder of the passwords, its log."""

    url: str
    folder: Path
    log: Path

    def password(self, user: str) -> str:
        """Of the administrator, or of a user that docker/team_user.py made."""
        if user == "admin":
            return (self.folder / "admin_password").read_text()
        return (self.folder / f"{user}.auth").read_text().strip().partition(":")[2]

    def ask(
        self, path: str, user: str | None = None, content: object = None, method: str | None = None
    ) -> tuple[int, bytes]:
        """Status and body of a request, as plain HTTP clients such as a cell send it."""
        request = urllib.request.Request(self.url + path, None if content is None else json.dumps(content).encode())
        request.method = method or request.get_method()
        request.add_header("Content-Type", "application/json")
        if user:
            token = base64.b64encode(f"{user}:{self.password(user)}".encode()).decode()
            request.add_header("Authorization", f"Basic {token}")
        try:
            with urllib.request.urlopen(request, timeout=30) as reply:
                return reply.status, reply.read()
        except urllib.error.HTTPError as error:
            return error.code, error.read()


@pytest.fixture(scope="module")
def server(put_tables, tmp_path_factory, repository):
    """MLflow with the rights of docker/basic_auth.ini, on SQLite."""
    folder = tmp_path_factory.mktemp("guarded")
    (folder / "admin_password").write_text(secrets.token_hex(12))
    rights = (repository / "docker/basic_auth.ini").read_text()
    shipped = "postgresql+psycopg2://mlflow@postgres/mlflow"
    assert shipped in rights
    (folder / "basic_auth.ini").write_text(rights.replace(shipped, f"sqlite:///{folder}/users.db"))
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MLFLOW")}
    environment |= {
        "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
        "MLFLOW_DISABLE_TELEMETRY": "true",
        "MLFLOW_AUTH_CONFIG_PATH": str(folder / "basic_auth.ini"),
        "MLFLOW_AUTH_ADMIN_PASSWORD": (folder / "admin_password").read_text(),
        "MLFLOW_FLASK_SERVER_SECRET_KEY": secrets.token_hex(12),
    }
    port = free_port()
    words = ["--host", "127.0.0.1", "--port", str(port), "--workers", "1", "--app-name", "basic-auth"]
    words += ["--backend-store-uri", put_tables(folder / "mlflow.db"), "--artifacts-destination", str(folder / "files")]
    guarded = Guarded(f"http://127.0.0.1:{port}", folder, folder / "log")
    with guarded.log.open("w") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "mlflow", "server", *words], env=environment, cwd=folder, stdout=log, stderr=log
        )
        try:
            until = time.monotonic() + 120
            while True:
                try:
                    assert guarded.ask("/health") == (200, b"OK")
                    break
                except OSError:
                    assert process.poll() is None, guarded.log.read_text()
                    assert time.monotonic() < until, guarded.log.read_text()
                    time.sleep(0.3)
            yield guarded
        finally:
            process.terminate()
            process.wait(30)


@pytest.fixture
def as_user(server, monkeypatch):
    """Become a user of the server, with his password or another; None is nobody."""

    def become(name, password=None):
        for variable, value in (("USERNAME", name), ("PASSWORD", name and (password or server.password(name)))):
            if value is None:
                monkeypatch.delenv(f"MLFLOW_TRACKING_{variable}", raising=False)
            else:
                monkeypatch.setenv(f"MLFLOW_TRACKING_{variable}", value)

    return become


@pytest.fixture(scope="module")
def users(server, repository):
    """``ann``, a person, and ``cell7``, a cell that picks brackets: made as the documentation says."""
    script = [sys.executable, repository / "docker/team_user.py"]
    place = ["--server", server.url, "--secrets", server.folder]
    for words in (["person", "ann"], ["cell", "cell7", "bracket"], ["cell", "cell7", "bracket"]):
        done = subprocess.run([*script, *words, *place], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        for user in ("ann", "cell7"):
            assert not (server.folder / f"{user}.auth").exists() or server.password(user) not in done.stdout
    assert "existed and keeps" in done.stdout
    assert (server.folder / "cell7.auth").stat().st_mode & 0o777 == 0o600
    wrong = subprocess.run([*script, "cell", "cell8", *place], capture_output=True, text=True, check=False)
    assert (wrong.returncode, "at least one PART" in wrong.stderr) == (2, True)


def test_without_the_right_password_connect_says_so_at_once(server, as_user, caplog):
    as_user(None)
    with pytest.raises(
        ConnectionError, match=r"must be given user and password, it got none \(HTTP 401\): set MLFLOW_"
    ):
        connect(server.url)
    as_user("admin", "not-the-password")
    with pytest.raises(ConnectionError, match=r"it refuses those of 'admin' \(HTTP 401\): set MLFLOW_") as caught:
        connect(server.url)
    assert "not-the-password" not in str(caught.value) + caplog.text


@pytest.mark.usefixtures("quick_training")
def test_a_verb_says_one_sentence_before_its_work(server, as_user, tmp_path, caplog):
    as_user("admin", "not-the-password")
    settings = [f"tracking.store={server.url}", f"root={tmp_path}/data", f"outputs={tmp_path}/outputs"]
    with pytest.raises(ConnectionError) as caught:
        train.run(compose(TrainSettings, ["object=connecting_rod", "experiment=smoke", *settings]))
    sentence = str(caught.value)
    assert sentence.startswith(f"tracking server {server.url} must be given user and password")
    assert "not-the-password" not in sentence + caplog.text
    assert "\n" not in sentence
    assert not [path for path in (tmp_path / "data").rglob("*") if path.is_file()]


@pytest.mark.usefixtures("users")
def test_people_share_experiments_and_no_password_is_logged(server, as_user, tmp_path, caplog, capfd):
    caplog.set_level(logging.INFO)
    (tmp_path / "last.ckpt").write_bytes(b"weights")
    ids = []
    for user in ("admin", "ann"):  # ann writes into what another has made
        as_user(user)
        with start_run(server.url, "rod", params={"lr": 1}, config_yaml="lr: 1", system_interval_s=0) as run:
            run.log_metrics({"train/loss": 1.0}, 0)
            run.log_file("checkpoints/last.ckpt", tmp_path / "last.ckpt")
            assert run.flush(60)
            assert run.download("checkpoints/last.ckpt", tmp_path / user).read_bytes() == b"weights"
            ids.append(run.id)
    assert connect(server.url).get_run(ids[0]).data.metrics == {"train/loss": 1.0}
    said = server.log.read_text() + caplog.text + "".join(capfd.readouterr())
    for user in ("admin", "ann", "cell7"):
        assert server.password(user) not in said


@pytest.mark.usefixtures("users")
def test_a_cells_user_follows_the_champion_and_moves_nothing(server, as_user, tmp_path):
    as_user("ann")
    client = connect(server.url)
    experiment = client.create_experiment("bracket")
    folder = tmp_path / "bundle"
    folder.mkdir()
    (folder / "model.onnx").write_bytes(b"graph")
    for name in (MODEL, "attentionvote-gear"):
        model = client.create_logged_model(experiment, name=name)
        client.log_model_artifacts(model.model_id, str(folder))
        client.finalize_logged_model(model.model_id, "READY")
        client.create_registered_model(name)
        row = client.create_model_version(name, f"models:/{model.model_id}", model_id=model.model_id)
        client.set_registered_model_alias(name, "champion", row.version)

    def path(page, name=MODEL, **query):
        return f"{page}?{urllib.parse.urlencode({'name': name, **query})}"

    alias, artifact = "/api/2.0/mlflow/registered-models/alias", "/model-versions/get-artifact"
    status, body = server.ask(path(alias, alias="champion"), "cell7")
    assert status == 200, body
    version = json.loads(body)["model_version"]["version"]
    assert server.ask(path(artifact, version=version, path="model.onnx"), "cell7") == (200, b"graph")
    # What it may not do: move, write, look at other parts; and nobody at all gets in.
    moved = {"name": MODEL, "alias": "champion", "version": version}
    refused = [
        server.ask(alias, "cell7", moved),
        server.ask(path(alias, alias="champion"), "cell7", moved, "DELETE"),
        server.ask("/api/2.0/mlflow/model-versions/create", "cell7", {"name": MODEL, "source": "models:/x"}),
        server.ask("/api/2.0/mlflow/registered-models/delete", "cell7", {"name": MODEL}, "DELETE"),
        server.ask(path(alias, "attentionvote-gear", alias="champion"), "cell7"),
        server.ask(path(artifact, "attentionvote-gear", version=1, path="model.onnx"), "cell7"),
        server.ask(f"/api/2.0/mlflow/experiments/get?experiment_id={experiment}", "cell7"),
        server.ask("/api/2.0/mlflow/runs/create", "cell7", {"experiment_id": experiment}),
        server.ask("/api/2.0/mlflow/experiments/create", "cell7", {"name": "mine"}),
        server.ask("/api/2.0/mlflow/users/create", "cell7", {"username": "x", "password": "y" * 20}),
    ]
    assert [status for status, _ in refused] == [403] * len(refused), refused
    for request in (path(alias, alias="champion"), path(artifact, version=version, path="model.onnx")):
        assert server.ask(request)[0] == 401
    assert client.get_model_version_by_alias(MODEL, "champion").version == version
    as_user("cell7")
    for known in ("bracket", "new"):
        with pytest.raises(PermissionError, match=f"write to experiment '{known}', it does not .HTTP 403.: its admin"):
            experiment_id(connect(server.url), server.url, known)
