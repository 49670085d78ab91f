"""Signals at any moment, and TLS handshakes that never end."""

from __future__ import annotations

import json
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from attentionvote.inference.server import health


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_a_signal_in_the_moment_after_the_address_ends_it_in_order(
    bundle_folder: Path, trusted_key: Path, tmp_path: Path, number: signal.Signals
) -> None:
    words = [sys.executable, "-m", "attentionvote.inference.command_line", "serve", str(bundle_folder), "--port", "0"]
    words += ["--key", str(trusted_key), "--state", str(tmp_path / "state")]
    for delay in (0.0, 0.002, 0.01, 0.05):
        with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            assert process.stdout is not None
            json.loads(process.stdout.readline())
            time.sleep(delay)
            process.send_signal(number)
            _, log = process.communicate(timeout=20)
            assert process.returncode == 0, log
            assert json.loads(log.splitlines()[-1])["event"] == "end"


def test_what_ignores_sighup_goes_on(bundle_folder: Path, trusted_key: Path, tmp_path: Path) -> None:
    words = ["nohup", sys.executable, "-m", "attentionvote.inference.command_line", "serve", str(bundle_folder)]
    words += ["--key", str(trusted_key), "--state", str(tmp_path / "state"), "--port", "0"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, stdin=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        url = json.loads(process.stdout.readline())["url"]
        os.kill(process.pid, signal.SIGHUP)
        time.sleep(0.5)
        host, port = url.partition("//")[2].split(":")
        with socket.create_connection((host, int(port)), timeout=10):
            pass
        process.terminate()
        process.communicate(timeout=20)
        assert process.returncode == 0


@pytest.mark.slow
def test_the_end_takes_less_than_docker_waits(start_server: Any, bundle_folder: Path) -> None:
    server = start_server(bundle_folder, "--deadline-ms", "60000")
    host, port = server.address.split(":")
    with socket.create_connection((host, int(port)), timeout=30) as connection:
        connection.sendall(b"POST /poses HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000\r\n\r\nhalf")
        time.sleep(0.5)  # its head is read, its body awaited
        begun = time.monotonic()
        server.process.send_signal(signal.SIGTERM)
        reply = b""
        while piece := connection.recv(65536):
            reply += piece
        assert server.process.wait(15) == 0
        assert time.monotonic() - begun < 9
    assert reply.startswith(b"HTTP/1.1 503 ")
    assert b"the request must end while the server does, but it took longer: send it again" in reply


@pytest.mark.slow
def test_a_handshake_that_never_ends_does_and_takes_no_place_meanwhile(
    start_server: Any, bundle_folder: Path, tmp_path: Path, certificate: Any
) -> None:
    cert, key = certificate(tmp_path)
    server = start_server(bundle_folder, "--tls-cert", str(cert), "--tls-key", str(key), ready=False, handles=128)
    server.wait_until(lambda: health.main(["--url", server.url]) == 0, "it is healthy over TLS")
    host, port = server.address.split(":")
    begun = time.monotonic()
    silent = [socket.create_connection((host, int(port)), timeout=20) for _ in range(100)]
    try:
        assert health.main(["--url", server.url]) == 0
        assert silent[-1].recv(1) == b""
        assert 9 < time.monotonic() - begun < 15
    finally:
        for connection in silent:
            connection.close()
    assert health.main(["--url", server.url]) == 0


def test_without_a_file_handle_it_waits_says_so_once_and_goes_on(start_server: Any, bundle_folder: Path) -> None:
    server = start_server(bundle_folder)
    pid = server.process.pid
    before = resource.prlimit(pid, resource.RLIMIT_NOFILE)
    resource.prlimit(pid, resource.RLIMIT_NOFILE, (3, before[1]))  # no handle beyond the first three
    host, port = server.address.split(":")
    with socket.create_connection((host, int(port)), timeout=30) as connection:
        connection.sendall(b"GET /v2/health/live HTTP/1.1\r\nHost: localhost\r\n\r\n")
        server.wait_until(lambda: bool(server.log("handles")), "the log says it")
        time.sleep(1)  # ten more tries
        resource.prlimit(pid, resource.RLIMIT_NOFILE, before)
        assert connection.recv(65536).startswith(b"HTTP/1.1 200 ")
    (line,) = server.log("handles")
    assert line["message"] == "no connection can be taken up (Too many open files); it is tried again"
