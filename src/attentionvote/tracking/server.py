"""An MLflow server (UI and REST) on the local store, on the loopback interface."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass

from attentionvote.tracking.sqlite_file import without_stray_folder
from attentionvote.tracking.store import artifact_root, connect, is_server, quiet_environment, resolve_store

# Run before the server's own program, in its process: the kernel ends it when whoever started it is gone, however that
# ended; MLflow hands the signal on to its child. 1 is PR_SET_PDEATHSIG, which outlives exec.
_WITH_STARTER = """
import ctypes, os, signal, sys
ctypes.CDLL(None).prctl(1, signal.SIGTERM)
if os.getppid() != int(sys.argv[1]):
    sys.exit("whoever started it has gone")
os.execv(sys.executable, [sys.executable, *sys.argv[2:]])
"""


@dataclass(frozen=True)
class Server:
    """A running server: its address, the store behind it and its process."""

    url: str
    store: str
    process: subprocess.Popen[bytes]


def free_port() -> int:
    """A TCP port of the loopback interface that nobody uses at the moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def serve(store: str | None = None, port: int = 0, timeout_s: float = 180.0) -> Iterator[Server]:
    """Serve a store until the block ends, or the thread that entered it.

    Args:
        store: see :func:`attentionvote.tracking.store.resolve_store`; not itself a server.
        port: 0 picks a free one.
        timeout_s: longest wait for the first answer.

    Raises:
        ValueError: the store is a server already, or cannot be used.
        OSError: the server ends or does not answer in time, with the last line it said.
    """
    uri = resolve_store(store)
    if is_server(uri):
        raise ValueError(f"only a local store needs a server, got {uri}, which is one: open it in a browser")
    connect(uri)  # creates the tables, or says in one sentence why the store cannot be used
    root = artifact_root(uri)
    assert root is not None
    port = port or free_port()
    quiet_environment()
    # One worker and no job runners: the default starts ten processes with 1.8 GB.
    environment = {**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
    environment.pop("MLFLOW_TRACKING_URI", None)
    environment["MLFLOW_BACKEND_STORE_URI"] = uri  # not an argument: it may hold a password, and `ps` shows those
    command = [sys.executable, "-S", "-c", _WITH_STARTER, str(os.getpid())]
    command += ["-m", "mlflow", "server", "--host", "127.0.0.1", "--port", str(port), "--workers", "1"]
    command += ["--artifacts-destination", root.as_uri()]
    url = f"http://127.0.0.1:{port}"
    with tempfile.TemporaryFile() as output, without_stray_folder(uri):
        # Its own session: the server's children end with it, and Ctrl-C reaches us alone.
        process = subprocess.Popen(
            command, env=environment, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            _wait_until_ready(process, url, timeout_s, output)
            yield Server(url, uri, process)
        finally:
            _end(process)


def _wait_until_ready(process: subprocess.Popen[bytes], url: str, timeout_s: float, output: object) -> None:
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if process.poll() is not None:
            raise OSError(f"the MLflow server ended at once (exit {process.returncode}): {_last_line(output)}")
        try:
            with urllib.request.urlopen(f"{url}/health", timeout=2):
                return
        except (urllib.error.URLError, OSError):
            time.sleep(0.2)
    raise OSError(f"the MLflow server must answer within {timeout_s:.0f} s, it did not: {_last_line(output)}")


def _last_line(output: object) -> str:
    output.seek(0)  # type: ignore[attr-defined]
    lines = output.read().decode(errors="replace").strip().splitlines()  # type: ignore[attr-defined]
    return lines[-1] if lines else "it said nothing"


def _end(process: subprocess.Popen[bytes]) -> None:
    for number, patience_s in ((signal.SIGTERM, 10.0), (signal.SIGKILL, None)):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)  # its own group: start_new_session
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=patience_s)
            return
