"""The profile ``team`` of docker/compose.yaml: what it promises, and its commands started natively on a PostgreSQL."""

from __future__ import annotations

import contextlib
import json
import os
import re
import stat
import subprocess
import sys
import time
import urllib.error
import urllib.request
from base64 import b64encode
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from attentionvote.inference import load_bundle
from attentionvote.registry.versions import Versions
from attentionvote.tracking.run_opening import start_run
from attentionvote.tracking.server import free_port
from attentionvote.tracking.store import connect

ROOT = Path(__file__).resolve().parents[2]
SECRETS = ("database_password", "admin_password", "server_key")
Compose = dict[str, Any]


def test_secrets_are_files_and_the_database_is_out_of_reach(compose: Compose) -> None:
    services = compose["services"]
    team = {name: service for name, service in services.items() if "profiles" in service}
    assert {name: service["profiles"] for name, service in team.items()} == {
        "mlflow-team": ["team"],
        "postgres": ["team"],
    }
    assert team["postgres"]["secrets"] == ["database_password"]
    assert set(team["mlflow-team"]["secrets"]) == set(SECRETS)
    for service in team.values():
        for name, value in service["environment"].items():
            if re.search("PASSWORD|KEY", name):
                assert name.endswith("_FILE"), name
                assert value.removeprefix("/run/secrets/") in service["secrets"]
    assert not [word for word in team["mlflow-team"]["command"] if re.search(r"://\w*:", word)]
    # The cell's side of the network has no way to the database, and nobody outside has.
    assert "ports" not in team["postgres"]
    assert team["postgres"]["networks"] == ["database"]
    assert compose["networks"]["database"] == {"internal": True}
    assert set(team["mlflow-team"]["networks"]) == {"default", "database"}
    assert not {"networks", "network_mode"} & set(services["inference"])
    assert team["mlflow-team"]["depends_on"] == {"postgres": {"condition": "service_healthy"}}
    # Ready is what answers over TCP: while the image fills its volume, it listens on its socket.
    assert team["postgres"]["healthcheck"]["test"][:5] == ["CMD", "pg_isready", "-q", "-h", "127.0.0.1"]
    assert team["postgres"]["volumes"] == ["team-database:/var/lib/postgresql/data"]
    assert team["mlflow-team"]["volumes"] == ["team-artifacts:/data"]
    assert {"team-database", "team-artifacts"} <= set(compose["volumes"])
    rules = (ROOT / "docker" / "Dockerfile.dockerignore").read_text(encoding="utf-8").splitlines()
    assert rules.index("docker/team") > rules.index("!docker")
    assert "/team/" in (ROOT / "docker" / ".gitignore").read_text(encoding="utf-8").splitlines()


@pytest.mark.parametrize("content", [None, ""], ids=["missing", "empty"])
def test_a_secret_that_is_not_there_is_one_sentence(content: str | None, tmp_path: Path) -> None:
    file = tmp_path / "admin_password"
    if content is not None:
        file.write_text(content, encoding="utf-8")
    environment = {"PATH": os.environ["PATH"], "MLFLOW_AUTH_ADMIN_PASSWORD_FILE": str(file)}
    script = ["sh", ROOT / "docker" / "mlflow-server.sh", "--help"]
    done = subprocess.run(script, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("mlflow-server.sh: ")
    assert "MLFLOW_AUTH_ADMIN_PASSWORD_FILE" in last
    assert str(file) in last


@dataclass(frozen=True)
class Team:
    """The running server.

    Attributes:
        url: on the loopback interface.
        secrets: folder of the secrets, as the documentation's commands made it.
        log: what it wrote.
        group: id of its processes' group.
    """

    url: str
    secrets: Path
    log: Path
    group: int

    def secret(self, name: str) -> str:
        """The text of one secret."""
        return (self.secrets / name).read_text(encoding="utf-8").strip()

    def ask(self, path: str, login: str = "", host: str = "mlflow:5000") -> tuple[int, bytes]:
        """Status and body of a GET, with ``user:password``, under the name of the compose network."""
        request = urllib.request.Request(self.url + path, headers={"Host": host})
        if login:
            request.add_header("Authorization", f"Basic {b64encode(login.encode()).decode()}")
        try:
            with urllib.request.urlopen(request, timeout=30) as reply:
                return reply.status, reply.read()
        except urllib.error.HTTPError as error:
            return error.code, error.read()


def documented(heading: str, command: str) -> list[str]:
    """The lines of the code block in a section of docs/container.md that holds a command, without docker's own."""
    text = (ROOT / "docs" / "container.md").read_text(encoding="utf-8")
    section = text.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    (block,) = [block for block in re.findall(r"```sh\n(.*?)```", section, re.DOTALL) if command in block]
    return [line for line in block.splitlines() if not line.startswith(("docker ", "    "))]


@pytest.fixture(scope="module")
def team(
    compose: Compose, stages: dict[str, Any], interpolate: Callable[..., str], postgresql: Any,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Team]:  # fmt: skip
    """The profile's MLflow by its own command, environment and entry point; only the places are others."""
    folder = tmp_path_factory.mktemp("team")
    (folder / "docker").mkdir()
    subprocess.run(
        ["sh", "-eu"], input="\n".join(documented("A team's server", "mkdir -m 700")), text=True, cwd=folder, check=True
    )
    secrets = folder / "docker" / "team"
    assert {path.name for path in secrets.iterdir()} == set(SECRETS)
    assert stat.S_IMODE(secrets.stat().st_mode) == 0o700
    assert all(stat.S_IMODE(path.stat().st_mode) == 0o444 for path in secrets.iterdir())

    image = {"POSTGRES_USER": "attentionvote", "PGHOST": str(postgresql.socket)}
    image |= {
        "POSTGRES_PASSWORD_FILE": str(secrets / "database_password"),
        "PATH": f"{postgresql.programs}:{os.environ['PATH']}",
    }
    subprocess.run(["sh", ROOT / "docker" / "make-database.sh"], env=image, check=True)

    service, port = compose["services"]["mlflow-team"], free_port()
    at_the_socket = ("@postgres/mlflow", f"@/mlflow?host={postgresql.socket}")
    rights = (ROOT / "docker" / "basic_auth.ini").read_text(encoding="utf-8")
    assert at_the_socket[0] in rights
    (folder / "basic_auth.ini").write_text(rights.replace(*at_the_socket), encoding="utf-8")
    (config,) = service["configs"]
    moved = {
        "/run/secrets": str(secrets), config["target"]: str(folder / "basic_auth.ini"),
        "/data/artifacts": str(folder / "artifacts"),
        at_the_socket[0]: at_the_socket[1], "0.0.0.0": "127.0.0.1", "--port=5000": f"--port={port}",
        "/opt/mlflow/bin": str(ROOT / "docker"),
    }  # fmt: skip

    def here(text: str) -> str:
        for before, after in moved.items():
            text = text.replace(before, after)
        return text

    hosts = f"mlflow:5000,127.0.0.1:{port}"
    words = [
        here(interpolate(word, TEAM_HOSTS=hosts)) for word in [*stages["mlflow"]["ENTRYPOINT"], *service["command"]]
    ]
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("MLFLOW", "PG"))}
    environment |= {name: value for name, value in stages["mlflow"]["ENV"].items() if name.startswith("MLFLOW")}
    environment |= {name: here(value) for name, value in service["environment"].items()}
    environment["PATH"] = f"{Path(sys.executable).parent}:{environment['PATH']}"
    log = folder / "log"
    with log.open("w") as output:
        process = subprocess.Popen(
            words, env=environment, cwd=folder, stdout=output, stderr=output, start_new_session=True
        )
        running = Team(f"http://127.0.0.1:{port}", secrets, log, process.pid)
        try:
            until = time.monotonic() + 120
            while True:
                try:
                    assert running.ask("/health") == (200, b"OK")
                    break
                except OSError:
                    assert process.poll() is None, log.read_text(encoding="utf-8")
                    assert time.monotonic() < until, log.read_text(encoding="utf-8")
                    time.sleep(0.3)
            yield running
        finally:
            process.terminate()
            process.wait(30)
            postgresql.drop("mlflow")
            postgresql.run("drop role mlflow")


@pytest.fixture
def person(team: Team, monkeypatch: pytest.MonkeyPatch) -> str:
    """``ann``, made as documented, whose password MLflow's client is given."""
    words = [sys.executable, ROOT / "docker" / "team_user.py", "person", "ann", "--server", team.url]
    done = subprocess.run([*words, "--secrets", team.secrets], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    login = (team.secrets / "ann.auth").read_text(encoding="utf-8").strip()
    monkeypatch.setenv("MLFLOW_TRACKING_USERNAME", "ann")
    monkeypatch.setenv("MLFLOW_TRACKING_PASSWORD", login.partition(":")[2])
    return login


@pytest.mark.slow
def test_nobody_gets_in_without_a_password_and_no_secret_is_shown(team: Team, postgresql: Any) -> None:
    search = "/api/2.0/mlflow/experiments/search?max_results=1"
    assert team.ask(search)[0] == 401
    assert team.ask(search, "admin:wrong")[0] == 401
    assert team.ask(search, f"admin:{team.secret('admin_password')}")[0] == 200
    assert team.ask(search, f"admin:{team.secret('admin_password')}", "stranger:5000")[0] == 403
    with pytest.raises(ConnectionError, match="must be given user and password"):
        connect(team.url)
    shown = [team.log.read_text(encoding="utf-8")]
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # just ended
            if os.getpgid(int(path.name)) == team.group:
                shown.append((path / "cmdline").read_bytes().decode())
    assert any("--app-name=basic-auth" in text for text in shown)
    for name in SECRETS:
        assert not [text for text in shown if team.secret(name) in text], name
    # MLflow's role owns its database and is nobody elsewhere.
    assert (
        postgresql.run("select rolsuper or rolcreatedb or rolcreaterole from pg_roles where rolname = 'mlflow'") == "f"
    )
    assert int(postgresql.run("select count(*) from users", "mlflow")) >= 1


@pytest.mark.slow
def test_runs_versions_and_their_files_go_through_it_and_come_back_from_a_backup(
    team: Team, person: str, cell: Any, postgresql: Any, tmp_path: Path
) -> None:
    (tmp_path / "last.ckpt").write_bytes(b"weights")
    with start_run(team.url, "bracket", params={"lr": 1}, system_interval_s=0) as run:
        run.log_metrics({"val/ap_10": 0.9}, 0)
        run.log_file("checkpoints/last.ckpt", tmp_path / "last.ckpt")
        assert run.flush(60)
        assert run.download("checkpoints/last.ckpt", tmp_path / "out").read_bytes() == b"weights"
    versions = Versions(team.url, "bracket")
    bundle = load_bundle(cell.bundles / "latest", cell.secrets / "signing.pub")
    version = versions.register(bundle, {})
    versions.set_champion(version)
    # As a cell does it.
    status, body = team.ask(f"/api/2.0/mlflow/registered-models/alias?name={versions.name}&alias=champion", person)
    assert (status, json.loads(body)["model_version"]["version"]) == (200, str(version.number))
    file = f"/model-versions/get-artifact?name={versions.name}&version={version.number}&path=model.onnx"
    assert team.ask(file, person) == (200, (cell.bundles / "latest" / "model.onnx").read_bytes())
    assert team.ask(file)[0] == 401

    dump = tmp_path / "team.dump"
    names = ["-h", postgresql.socket, "-U", "attentionvote"]
    subprocess.run([postgresql.programs / "pg_dump", *names, "-Fc", "-f", dump, "mlflow"], check=True)
    again = postgresql.create()
    subprocess.run(
        [postgresql.programs / "pg_restore", *names, "-d", again, "--clean", "--if-exists", dump], check=True
    )
    found = postgresql.run("select name, version from registered_model_aliases where alias = 'champion'", again)
    postgresql.drop(again)
    assert found == f"{versions.name}|{version.number}"


@pytest.mark.slow
def test_a_repeat_takes_rights_away_and_takes_up_a_killed_runs_password(team: Team) -> None:
    def rights(*words: str) -> set[tuple[str, str, str]]:
        script = [sys.executable, ROOT / "docker" / "team_user.py", *words, "--server", team.url]
        done = subprocess.run([*script, "--secrets", team.secrets], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        listed = "/api/3.0/mlflow/users/permissions/list?username=cell9"
        status, body = team.ask(listed, f"admin:{team.secret('admin_password')}")
        assert status == 200
        keys = ("resource_type", "resource_pattern", "permission")
        return {tuple(row[key] for key in keys) for row in json.loads(body)["permissions"]}

    closed = ("experiment", "*", "DENY")
    gear, rod = (("registered_model", f"attentionvote-{part}", "READ") for part in ("gear", "rod"))
    assert rights("cell", "cell9", "gear", "rod") == {closed, gear, rod}
    file, pending = team.secrets / "cell9.auth", team.secrets / "cell9.auth.new"
    login = team.secret("cell9.auth")
    file.rename(pending)  # as a run leaves it that was killed after the server had made the user
    assert rights("cell", "cell9", "gear") == {closed, gear}
    assert team.secret("cell9.auth") == login
    assert not pending.exists()
    file.chmod(0o644)
    person = {("experiment", "*", "EDIT"), ("registered_model", "*", "EDIT")}
    assert rights("person", "cell9") == person
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert team.secret("cell9.auth") == login
    assert rights("cell", "cell9", "rod") == {closed, rod}
