"""The containers of docker/compose.yaml: closed down as far as they go, and MLflow's arguments as a real server."""

from __future__ import annotations

import argparse
import http.client
import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import attentionvote
from attentionvote.inference.server import serve
from attentionvote.inference.server.model.source import source_of

ROOT = Path(__file__).resolve().parents[2]
USER = "65532:65532"


@pytest.mark.parametrize("name", ["inference", "mlflow", "mlflow-team", "postgres"])
def test_a_container_may_do_no_more_than_it_must(compose: dict[str, Any], name: str) -> None:
    service = compose["services"][name]
    assert service["read_only"] is True
    sockets = ["/var/run/postgresql"] if name == "postgres" else []
    assert [entry.split(":")[0] for entry in service["tmpfs"]] == ["/tmp", *sockets]
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service["pids_limit"] <= 256
    assert service["mem_limit"] in ("2g", "3g", "4g")
    # Signals reach a process that has no handler for them yet, and no log fills the disk.
    assert service["init"] is True
    logs = service["logging"]
    assert logs["driver"] == "json-file"
    assert (logs["options"]["max-size"], int(logs["options"]["max-file"])) == ("10m", 5)
    assert not {"privileged", "cap_add", "network_mode", "pid", "devices"} & set(service)
    # Our images name their user; PostgreSQL's would start as root.
    assert service.get("user") == ("999:999" if name == "postgres" else None)
    own_machine = ("127.0.0.1", "${CELL_ADDRESS:-127.0.0.1}", "${TEAM_ADDRESS:-127.0.0.1}")
    assert all(port.rsplit(":", 2)[0] in own_machine for port in service.get("ports", []))


def test_the_images_are_built_here_with_fixed_versions(compose: dict[str, Any], stages: dict[str, Any]) -> None:
    tracking = (ROOT / "constraints.txt").read_text(encoding="utf-8").partition("\nmlflow==")[2].partition("\n")[0]
    services = compose["services"]
    assert services["inference"]["image"] == f"attentionvote:{attentionvote.__version__}"
    assert services["mlflow"]["image"] == services["mlflow-team"]["image"] == f"attentionvote-mlflow:{tracking}"
    assert re.fullmatch(r"docker\.io/library/postgres:15\.\d+-bookworm", services["postgres"]["image"])
    for name, service in services.items():
        if name == "postgres":
            continue
        build = service["build"]
        assert (ROOT / "docker" / build["context"]).resolve() == ROOT
        assert (ROOT / build["dockerfile"]).is_file()
        assert stages[build["target"]]["USER"] == USER


def test_only_the_state_can_be_written(compose: dict[str, Any], stages: dict[str, Any]) -> None:
    service, image = compose["services"]["inference"], stages["inference"]
    volumes = {entry.rsplit(":", 1)[-1] if not entry.endswith(":ro") else entry for entry in service["volumes"]}
    assert volumes == {"/state", "${CELL_BUNDLES:-./cell/bundles}:/bundles:ro"}
    assert set(service["secrets"]) == {"token", "signing.pub", "registry", "tls.crt", "tls.key"}
    words = image["CMD"]
    given = dict(zip(words[2::2], words[3::2], strict=True))
    assert words[:2] == ["serve", "/bundles/latest"]
    assert given["--state"] == image["VOLUME"] == "/state"
    assert (given["--token-file"], given["--key"]) == ("/run/secrets/token", "/run/secrets/signing.pub")
    assert compose["services"]["mlflow"]["volumes"] == ["mlflow:/data"]


def test_the_cell_has_the_time_to_end_in_order(compose: dict[str, Any]) -> None:
    (seconds,) = re.findall(r"^(\d+)s$", compose["services"]["inference"]["stop_grace_period"])
    assert int(seconds) > serve._DRAIN_S + serve._THREADS_S


def test_tls_is_two_files(compose: dict[str, Any], interpolate: Callable[..., str]) -> None:
    """The health check needs nothing for it: the server says itself where it is."""
    command, secrets = compose["services"]["inference"]["command"], compose["secrets"]
    files = {"CELL_TLS_CERT": "cell/tls.crt", "CELL_TLS_KEY": "cell/tls.key"}
    parser = argparse.ArgumentParser()
    serve.add_arguments(parser)
    plain = parser.parse_args(shlex.split(interpolate(command))[1:])
    assert (plain.tls_cert, plain.tls_key) == (None, None)
    options = parser.parse_args(shlex.split(interpolate(command, **files))[1:])
    for name, option in (("tls.crt", options.tls_cert), ("tls.key", options.tls_key)):
        assert str(option) == f"/run/secrets/{name}"
        assert interpolate(secrets[name]["file"]) == "/dev/null"
        assert interpolate(secrets[name]["file"], **files) == f"cell/{name}"


def test_the_cell_serves_its_folder_until_it_is_told_to_follow_a_registry(
    compose: dict[str, Any],
    stages: dict[str, Any],
    interpolate: Callable[..., str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    command, file = compose["services"]["inference"]["command"], compose["secrets"]["registry"]["file"]
    plain = shlex.split(interpolate(command))
    assert plain == stages["inference"]["CMD"]
    assert interpolate(file) == "/dev/null"
    told = {
        "CELL_MODEL": "models:/attentionvote-gear@champion",
        "CELL_REGISTRY": "https://team",
        "CELL_REGISTRY_AUTH": "f",
    }
    words = shlex.split(interpolate(command, **told))
    assert words[:2] == ["serve", told["CELL_MODEL"]]
    assert words[-2:] == ["--registry-auth-file", "/run/secrets/registry"]
    assert interpolate(file, **told) == "f"
    parser = argparse.ArgumentParser()
    serve.add_arguments(parser)
    address = compose["services"]["inference"]["environment"]["MLFLOW_TRACKING_URI"]
    (tmp_path / "registry").write_text("cell7:p\n", encoding="utf-8")
    words[-1] = str(tmp_path / "registry")
    for name in ("MLFLOW_TRACKING_USERNAME", "MLFLOW_TRACKING_PASSWORD"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", interpolate(address))
    folder = source_of(parser.parse_args(plain[1:]))
    assert (folder.name, folder.access) == (Path("/bundles/latest"), None)
    alone = shlex.split(interpolate(command, CELL_MODEL=told["CELL_MODEL"]))
    followed = source_of(parser.parse_args(alone[1:])).access
    assert followed is not None
    assert (followed.url, followed.authorization) == ("http://mlflow:5000", None)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", interpolate(address, **told))
    followed = source_of(parser.parse_args(words[1:])).access
    assert followed is not None
    assert (followed.url, followed.authorization is not None) == ("https://team", True)


def ask(port: int, host: str) -> int:
    """The status of a request to MLflow's REST interface under a host name."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    try:
        connection.request("GET", "/api/2.0/mlflow/experiments/search?max_results=1", headers={"Host": host})
        return connection.getresponse().status
    finally:
        connection.close()


@pytest.mark.slow
def test_mlflow_answers_under_its_name_in_the_network_and_to_no_stranger(
    compose: dict[str, Any], stages: dict[str, Any], tmp_path: Path, free_port: int
) -> None:
    service = compose["services"]["mlflow"]
    assert service["environment"] == {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
    assert "--serve-artifacts" in service["command"]
    moved = {"/data": str(tmp_path), "0.0.0.0": "127.0.0.1", "--port=5000": f"--port={free_port}"}
    words = [*stages["mlflow"]["ENTRYPOINT"], *service["command"]]
    for before, after in moved.items():
        assert any(before in word for word in words), before
        words = [word.replace(before, after) for word in words]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("MLFLOW")}
    environment |= {k: v for k, v in stages["mlflow"]["ENV"].items() if k.startswith("MLFLOW")} | service["environment"]
    words = [word.replace("/opt/mlflow/bin", str(ROOT / "docker")) for word in words]
    environment["PATH"] = f"{Path(sys.executable).parent}:{environment['PATH']}"
    silent = subprocess.DEVNULL
    process = subprocess.Popen(words, env=environment, cwd=tmp_path, stdout=silent, stderr=silent)
    try:
        until = time.monotonic() + 120
        while True:
            try:
                assert ask(free_port, "mlflow:5000") == 200
                break
            except ConnectionError:
                assert process.poll() is None, "the server ended"
                assert time.monotonic() < until
                time.sleep(0.3)
        assert ask(free_port, "localhost:5000") == 200
        assert ask(free_port, "stranger:5000") == 403
        assert (tmp_path / "mlflow.db").is_file()
    finally:
        process.terminate()
        process.wait(30)
