"""Real servers for the tests: a process of its own each, on a free port, with its log in a file."""

from __future__ import annotations

import http.client
import json
import os
import re
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import pytest
from numpy.typing import NDArray

PATIENCE_S = 30.0


class Reply(NamedTuple):
    """An HTTP answer."""

    status: int
    headers: http.client.HTTPMessage
    body: bytes

    @property
    def json(self) -> Any:
        """The body as JSON."""
        return json.loads(self.body)

    @property
    def error(self) -> str:
        """The sentence of a refusal."""
        return str(self.json["error"])


@dataclass
class ServerProcess:
    """A running server."""

    process: subprocess.Popen[str]
    url: str
    log_file: Path
    headers: dict[str, str] = field(default_factory=dict)

    @property
    def address(self) -> str:
        """HOST:PORT."""
        return self.url.partition("//")[2]

    def ask(
        self, method: str, path: str, body: Any = None, headers: Mapping[str, str] | None = None, timeout: float = 20.0
    ) -> Reply:
        """One request on a connection of its own."""
        connection = http.client.HTTPConnection(self.address, timeout=timeout)
        try:
            connection.request(method, path, body, {**self.headers, **(headers or {})})
            response = connection.getresponse()
            return Reply(response.status, response.headers, response.read())
        finally:
            connection.close()

    def get(self, path: str) -> Reply:
        """GET."""
        return self.ask("GET", path)

    def post(self, path: str, body: Any = b"", headers: Mapping[str, str] | None = None) -> Reply:
        """POST."""
        return self.ask("POST", path, body, headers)

    def log(self, event: str | None = None) -> list[dict[str, Any]]:
        """The log's lines, of one event."""
        lines = [json.loads(line) for line in self.log_file.read_text(encoding="utf-8").splitlines()]
        return [line for line in lines if event in (None, line["event"])]

    def metric(self, name: str, **labels: str) -> float:
        """The value of a metric; NaN when it is not there."""
        given = ",".join(f'{key}="{value}"' for key, value in sorted(labels.items()))
        wanted = f"attentionvote_{name}{{{given}}}" if given else f"attentionvote_{name}"
        for line in self.get("/metrics").body.decode().splitlines():
            if line.startswith(wanted + " "):
                return float(line.rpartition(" ")[2])
        return float("nan")

    def reload_error(self) -> str:
        """The sentence in the metrics; empty without."""
        found = re.search(r'attentionvote_reload_error_info\{error="(.*)"\} 1', self.get("/metrics").body.decode())
        return found[1] if found else ""

    def version(self) -> str:
        """Of the model that serves; empty when none does."""
        with suppress(OSError, http.client.HTTPException):
            reply = self.get("/v2/health/ready")
            return str(reply.json.get("version", ""))
        return ""

    def wait_until(self, condition: Callable[[], bool], what: str, patience_s: float = PATIENCE_S) -> None:
        """Wait for a condition, or fail with the log."""
        until = time.monotonic() + patience_s
        while not condition():
            if time.monotonic() > until or self.process.poll() is not None:
                log = "\n".join(json.dumps(line) for line in self.log() if line["event"] != "request")
                pytest.fail(f"waited in vain until {what} (exit code {self.process.poll()}); log:\n{log}")
            time.sleep(0.02)

    def wait_ready(self) -> ServerProcess:
        """Wait until a model serves."""
        self.wait_until(lambda: self.version() != "", "the server is ready")
        return self

    def stop(self) -> int:
        """SIGTERM; the exit code."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(PATIENCE_S)

    def kill(self) -> None:
        """kill -9."""
        self.process.kill()
        self.process.wait(PATIENCE_S)


class StartServer(Protocol):
    """What the fixture ``start_server`` offers."""

    def __call__(
        self,
        bundle: Path,
        *options: str,
        environment: Mapping[str, str] | None = None,
        ready: bool = True,
        handles: int | None = None,
    ) -> ServerProcess: ...


@dataclass
class _Started:
    """Servers of one scope."""

    folder: Path
    key: Path
    servers: list[ServerProcess] = field(default_factory=list)

    def start(
        self,
        bundle: Path,
        *options: str,
        environment: Mapping[str, str] | None = None,
        ready: bool = True,
        handles: int | None = None,
    ) -> ServerProcess:
        number = len(self.servers)
        self.folder.mkdir(parents=True, exist_ok=True)
        log_file = self.folder / f"server{number}.log"
        words = [str(bundle), "--port", "0", "--poll-s", "0.1", *options]
        if "--key" not in options:
            words += ["--key", str(self.key)]
        if "--state" not in options:
            words += ["--state", str(self.folder / f"state{number}")]
        with log_file.open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "attentionvote.inference.command_line", "serve", *words],
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                env={**os.environ, **(environment or {})},
                preexec_fn=None if handles is None else partial(_limit_handles, handles),
            )
        assert process.stdout is not None
        line = process.stdout.readline()
        if not line:
            process.wait(PATIENCE_S)
            pytest.fail(f"the server did not start: {log_file.read_text(encoding='utf-8')}")
        server = ServerProcess(process, json.loads(line)["url"], log_file)
        self.servers.append(server)
        return server.wait_ready() if ready else server

    def end(self) -> None:
        for server in self.servers:
            if server.process.poll() is None:
                server.process.terminate()
        for server in self.servers:
            try:
                server.process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                server.kill()
            assert server.process.stdout is not None
            server.process.stdout.close()


def _limit_handles(handles: int) -> None:
    """``ulimit -n``."""
    resource.setrlimit(resource.RLIMIT_NOFILE, (handles, handles))


def _no_tracebacks(started: _Started) -> None:
    for server in started.servers:
        failed = [line for line in server.log() if "traceback" in line or line["level"] == "critical"]
        assert not failed, failed


@pytest.fixture
def start_server(tmp_path: Path, trusted_key: Path) -> Iterator[StartServer]:
    """Starts servers that end with the test, and fails it when one of them logged a traceback."""
    started = _Started(tmp_path / "servers", trusted_key)
    try:
        yield started.start
    finally:
        started.end()
    _no_tracebacks(started)


@pytest.fixture(scope="session")
def _shared(tmp_path_factory: pytest.TempPathFactory, trusted_key: Path) -> Iterator[dict[str, _Started]]:
    all_started = {
        name: _Started(tmp_path_factory.mktemp(f"{name}-server"), trusted_key) for name in ("shared", "slow")
    }
    try:
        yield all_started
    finally:
        for started in all_started.values():
            started.end()
    for started in all_started.values():
        _no_tracebacks(started)


@pytest.fixture
def slow_server(_shared: dict[str, _Started], make_bundle: Any) -> ServerProcess:
    """Shared as well: an estimate takes most of a second, one request may wait, the deadline is 30 s."""
    started = _shared["slow"]
    if not started.servers:
        bundle = make_bundle("slow-bundle", graph={"loops": 400_000})
        started.start(bundle, "--queue", "1", "--deadline-ms", "30000", "--poll-s", "60")
    server = started.servers[0]
    server.wait_until(lambda: server.metric("queue_depth") == 0, "the test before has ended")
    return server


@pytest.fixture
def shared_server(_shared: dict[str, _Started], make_bundle: Any) -> ServerProcess:
    """A server of the tiny bundle that all tests of the session share: none of them may change it.

    It takes bodies of at most 1 MiB and has a camera.
    """
    started = _shared["shared"]
    if not started.servers:
        cell = started.folder / "cell.json"
        cell.write_text(json.dumps({"camera": {"fx": 300.0, "fy": 300.0, "cx": 79.5, "cy": 59.5}}))
        started.start(make_bundle("shared-bundle"), "--max-body-mb", "1", "--cell", str(cell), "--poll-s", "60")
    server = started.servers[0]
    assert server.process.poll() is None, server.log_file.read_text(encoding="utf-8")
    return server


@pytest.fixture(scope="session")
def npy() -> Callable[[NDArray[Any]], bytes]:
    """The bytes of a .npy file."""

    def encode(array: NDArray[Any]) -> bytes:
        import io

        stream = io.BytesIO()
        np.save(stream, array)
        return stream.getvalue()

    return encode


@pytest.fixture(scope="session")
def infer_body() -> Callable[..., tuple[bytes, dict[str, str]]]:
    """A request of the Open Inference Protocol with binary tensors: body and headers."""

    def encode(points: NDArray[np.float32], **parameters: Any) -> tuple[bytes, dict[str, str]]:
        raw = points.astype("<f4").tobytes()
        tensor = {"name": "points", "datatype": "FP32", "shape": list(points.shape)}
        tensor["parameters"] = {"binary_data_size": len(raw)}
        head = json.dumps({"inputs": [tensor], "parameters": parameters}).encode()
        return head + raw, {"Inference-Header-Content-Length": str(len(head))}

    return encode


@contextmanager
def asking_all_the_time(server: Any, body: bytes) -> Iterator[list[dict[str, Any]]]:
    """Two clients that ask all the time; every answer must be one."""
    answers: list[dict[str, Any]] = []
    failures: list[str] = []
    end = threading.Event()

    def ask() -> None:
        while not end.is_set():
            try:
                reply = server.post("/poses", body)
                if reply.status == 200:
                    answers.append(reply.json)
                else:
                    failures.append(f"{reply.status}: {reply.error}")
            except OSError as error:
                failures.append(repr(error))
            time.sleep(0.01)

    clients = [threading.Thread(target=ask) for _ in range(2)]
    for client in clients:
        client.start()
    try:
        yield answers
    finally:
        end.set()
        for client in clients:
            client.join()
    assert not failures
    assert len(answers) > 10


@pytest.fixture(scope="session")
def continuous_requests() -> Callable[..., Any]:
    """A context in which two clients ask all the time; their answers. It fails at its end when one got none."""
    return asking_all_the_time
