"""``attentionvote serve``: options that cannot work, TLS, an orderly end, and what the process never touches."""

from __future__ import annotations

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from attentionvote.inference.client.pose_client import PoseClient, Unreachable
from attentionvote.inference.server import health, serve

COMMAND = [sys.executable, "-m", "attentionvote.inference.command_line", "serve"]


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The one sentence that the verb ends with, exit code 2."""
    import argparse

    parser = argparse.ArgumentParser()
    serve.add_arguments(parser)
    assert serve.run(parser.parse_args(words)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_options_that_cannot_work_are_one_sentence(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, trusted_key: Path, certificate: Any
) -> None:
    cert, key = certificate(tmp_path)
    good = ["bundle", "--key", str(trusted_key), "--state", str(tmp_path / "state")]
    for words, sentence in (
        (["--host", "0.0.0.0"], "must be a loopback address such as 127.0.0.1 without --token-file, got '0.0.0.0'"),
        (["--token-file", str(tmp_path / "none")], "must be readable, but: No such file"),
        (["--port", "70000"], "--port must be between 0 and 65535, got 70000"),
        (["--queue", "-1"], "--queue must be between 0 and 1000, got -1"),
        (["--deadline-ms", "nan"], "--deadline-ms must be between 1 and 10000, got nan"),
        (["--max-body-mb", "0"], "--max-body-mb must be between 0.001 and 1024, got 0"),
        (["--poll-s", "0"], "--poll-s must be between 0.05 and 3600, got 0"),
        (["--registry-poll-s", "0"], "--registry-poll-s must be between 0.05 and 3600, got 0"),
        (
            ["--registry", "http://mlflow:5000"],
            "models:/NAME/VERSION, got the path bundle",
        ),
        (["--threads", "0"], "--threads must be between 1 and 1024, got 0"),
        (["--tls-cert", str(cert)], "--tls-cert and --tls-key must be given together, got one of them"),
        (["--tls-cert", str(cert), "--tls-key", str(tmp_path / "locked.pem")], "must be a PEM certificate and its key"),
        (["--tls-cert", str(key), "--tls-key", str(key)], "must be a PEM certificate and its key"),
        (["--cell", str(tmp_path / "cell.json")], "cell.json cannot be read"),
        (["--key", str(tmp_path / "no.pub")], "no.pub must be a public key"),
    ):
        line = refused(capsys, *good, *words)
        assert line.startswith("serve: ")
        assert sentence in line


def test_a_registry_that_cannot_be_followed_is_one_sentence(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, trusted_key: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "sqlite:///outputs/mlflow.db")
    (tmp_path / "file").write_text("no folder")
    state = ["--key", str(trusted_key), "--state", str(tmp_path / "state")]
    address = ["--registry", "http://127.0.0.1:9"]
    for words, sentence in (
        (["models:/gear/Production", *address], "got 'models:/gear/Production', did you mean models:/gear@champion?"),
        (["models:/gear@champion"], "must be http://HOST:PORT or https://HOST:PORT, got 'sqlite:///outputs/mlflow.db'"),
        (["models:/gear@champion", "--registry", "http://cell:hunter2@mlflow"], "must not hold credentials"),
        (
            ["models:/gear@champion", *address, "--registry-auth-file", str(tmp_path / "no")],
            "be readable, but",
        ),
        (
            ["models:/gear@champion", *address, "--key", str(trusted_key), "--state", str(tmp_path / "file" / "state")],
            "models:/gear@champion needs a state folder to fetch bundles into, but",
        ),
    ):
        line = refused(capsys, *(words if "--state" in words else [*words, *state]))
        assert line.startswith("serve: ")
        assert sentence in line
        assert "hunter2" not in line


def test_a_state_folder_and_a_port_belong_to_one_server(
    start_server: Any, bundle_folder: Path, trusted_key: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    server = start_server(bundle_folder, "--state", str(tmp_path / "state"))
    words = [str(bundle_folder), "--key", str(trusted_key), "--state"]
    assert "another one that runs holds it: name another with --state" in refused(
        capsys, *words, str(tmp_path / "state")
    )
    port = server.address.split(":")[1]
    done = subprocess.run(
        [*COMMAND, *words, str(tmp_path / "other"), "--port", port],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert done.returncode == 1
    assert done.stdout == ""
    assert (
        done.stderr.splitlines()[-1]
        == f"serve: 127.0.0.1 port {port} must be free to listen on, but: Address already in use"
    )


def test_sigterm_drains_and_ends_with_0(start_server: Any, make_bundle: Any, make_cloud: Any, npy: Any) -> None:
    server = start_server(make_bundle(graph={"loops": 400_000}), "--deadline-ms", "30000")
    host, port = server.address.split(":")
    with socket.create_connection((host, int(port))):  # an idle connection does not hold it up
        replies: list[Any] = []
        running = threading.Thread(target=lambda: replies.append(server.post("/poses", npy(make_cloud()))))
        running.start()
        server.wait_until(lambda: server.metric("queue_depth") == 1, "the request runs")
        server.process.send_signal(signal.SIGTERM)
        assert server.process.wait(15) == 0
        running.join()
    assert replies[0].status == 200
    assert len(replies[0].json["poses"]) == 2
    assert server.log()[-1]["event"] == "end"
    with pytest.raises(ConnectionRefusedError):
        server.get("/v2/health/live")


def test_a_thread_that_hangs_does_not_keep_the_process() -> None:
    program = """
import threading, time
from attentionvote.inference.server.serve import _leave
threading.Thread(target=time.sleep, args=(100,), name="stuck").start()
_leave(None)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0
    assert "the thread stuck does not end and is left" in done.stderr


def test_tls_and_token_end_to_end(
    start_server: Any,
    bundle_folder: Path,
    make_cloud: Any,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    certificate: Any,
) -> None:
    cert, key = certificate(tmp_path)
    token = tmp_path / "token"
    token.write_text("correct-horse-battery")
    options = ("--tls-cert", str(cert), "--tls-key", str(key), "--token-file", str(token), "--host", "0.0.0.0")
    server = start_server(bundle_folder, *options, ready=False)
    url = f"https://127.0.0.1:{server.url.rpartition(':')[2]}"
    server.wait_until(lambda: health.main(["--url", url]) == 0, "it is healthy over TLS")
    assert capsys.readouterr().out.startswith("ready: bracket ")
    with PoseClient(url, token="correct-horse-battery", ca_file=cert) as client:
        assert client.ready()
        assert len(client.estimate(make_cloud()).confidence) == 2
    with PoseClient(url, token="correct-horse-battery") as client, pytest.raises(Unreachable, match="certificate"):
        client.estimate(make_cloud())


def test_tokens_in_clear_are_warned_of_once(
    start_server: Any, bundle_folder: Path, certificate: Any, tmp_path: Path
) -> None:
    cert, key = certificate(tmp_path)
    token = tmp_path / "token"
    token.write_text("correct-horse-battery")
    token.chmod(0o600)
    everywhere = ("--token-file", str(token), "--host", "0.0.0.0")
    for options, count in (
        (everywhere, 1),
        ((*everywhere, "--tls-cert", str(cert), "--tls-key", str(key)), 0),
        (("--token-file", str(token)), 0),
    ):
        server = start_server(bundle_folder, *options, ready=False)
        server.wait_until(lambda server=server: server.log("model") != [], "it serves")
        warnings = [line for line in server.log("token") if line["level"] == "warning"]
        assert len(warnings) == count, options
        assert all("tokens cross the network unencrypted: give --tls-cert" in line["message"] for line in warnings)


def test_the_server_imports_no_training_stack_and_leaves_nothing_at_home(
    make_bundle: Any, trusted_key: Path, make_cloud: Any, npy: Any, tmp_path: Path
) -> None:
    home, cloud = tmp_path / "home", tmp_path / "cloud.npy"
    home.mkdir()
    cloud.write_bytes(npy(make_cloud()))
    blocked = (
        "torch",
        "lightning",
        "mlflow",
        "hydra",
        "omegaconf",
        "trimesh",
        "jaxtyping",
        "open3d",
        "onnx",
        "onnxscript",
        "onnx_ir",
    )
    program = f"""
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {blocked!r}:
            raise ImportError(f"{{name}} is not on the cell")
sys.meta_path.insert(0, Blocked())
import os, threading, time, urllib.request
def ask():
    while True:
        try:
            urllib.request.urlopen("http://127.0.0.1:" + port + "/v2/health/ready")
            break
        except OSError:
            time.sleep(0.02)
    body = open({str(cloud)!r}, "rb").read()
    print(urllib.request.urlopen("http://127.0.0.1:" + port + "/poses", body).read().decode(), flush=True)
    os.kill(os.getpid(), 15)
import socket
with socket.socket() as probe:
    probe.bind(("127.0.0.1", 0))
    port = str(probe.getsockname()[1])
threading.Thread(target=ask, daemon=True).start()
from attentionvote.inference.command_line import main
main(["serve", {str(make_bundle())!r}, "--key", {str(trusted_key)!r}, "--port", port,
      "--state", {str(tmp_path / "state")!r}])
"""
    environment = {**os.environ, "HOME": str(home), "XDG_CACHE_HOME": str(home / "cache")}
    environment.pop("ORT_DISABLE_TELEMETRY", None)
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        cwd=home,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[1])["answer"] == "estimate"
    assert list(home.rglob("*")) == []


def test_a_body_does_not_wait_for_its_head_to_be_acknowledged(shared_server: Any) -> None:
    """Sockets whose protocol is not named are sent with Nagle's delay: 40 ms an answer on a connection that is kept."""
    connection = http.client.HTTPConnection(shared_server.address, timeout=20)
    seconds = []
    for _ in range(21):
        begun = time.monotonic()
        connection.request("POST", "/poses", b"nothing")
        assert connection.getresponse().read()
        seconds.append(time.monotonic() - begun)
    connection.close()
    assert sorted(seconds)[10] < 0.03
