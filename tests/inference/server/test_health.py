"""The health check without curl."""

from __future__ import annotations

import http.server
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from attentionvote.inference.server import health


def test_ready(shared_server: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert health.main(["--url", shared_server.url]) == 0
    assert capsys.readouterr().out == f"ready: bracket {shared_server.version()}\n"


def test_it_is_a_verb_of_the_command_line_and_a_module(shared_server: Any) -> None:
    for module in (["attentionvote.inference.command_line", "health"], ["attentionvote.inference.server.health"]):
        done = subprocess.run(
            [sys.executable, "-m", *module, "--url", shared_server.url],
            capture_output=True,
            text=True,
            timeout=30,
            check=False,
        )
        assert (done.returncode, done.stderr) == (0, "")
        assert done.stdout.startswith("ready: bracket ")


def test_not_ready_says_why(start_server: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    server = start_server(tmp_path / "nowhere", ready=False)
    server.wait_until(lambda: server.metric("reload_failing") == 1, "it has looked")
    assert health.main(["--url", server.url]) == 1
    assert "not ready (503): no model is ready: " in capsys.readouterr().err
    server.kill()
    assert health.main(["--url", server.url]) == 1
    assert "cannot be reached: [Errno 111] Connection refused" in capsys.readouterr().err


def test_the_running_server_is_found_whatever_its_port_and_tls(
    start_server: Any, bundle_folder: Path, certificate: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(health, "URL", "http://127.0.0.1:1")
    cert, key = certificate(tmp_path)
    (tmp_path / "token").write_text("correct-horse-battery")
    options = ("--host", "0.0.0.0", "--tls-cert", str(cert), "--tls-key", str(key))
    server = start_server(bundle_folder, *options, "--token-file", str(tmp_path / "token"), ready=False)
    server.wait_until(lambda: health.main([]) == 0, "it is healthy without an address")
    assert server.stop() == 0
    assert health.main([]) == 1
    assert not list(tmp_path.glob("attentionvote-*/*"))


def test_a_dead_server_is_not_asked_and_several_are_told_apart(
    start_server: Any,
    bundle_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(health, "URL", "http://127.0.0.1:1")
    first, second = start_server(bundle_folder), start_server(bundle_folder)
    assert health.main([]) == 2
    urls = sorted([first.url, second.url])
    sentence = "--url must say which server is asked where several run, got none: one of " + ", ".join(urls)
    assert sentence in capsys.readouterr().err
    first.kill()
    assert health.main([]) == 0
    second.kill()
    assert health.main([]) == 1
    assert "http://127.0.0.1:1/v2/health/ready cannot be reached" in capsys.readouterr().err


class Stranger(http.server.BaseHTTPRequestHandler):
    """Some other server."""

    def do_GET(self) -> None:
        self.send_response(200 if self.path.startswith("/v2") else 404)
        self.end_headers()
        self.wfile.write(b"<html>")

    def log_message(self, *_: object) -> None:
        """Nothing."""


def test_another_server_is_told_apart(capsys: pytest.CaptureFixture[str]) -> None:
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Stranger) as stranger:
        thread = threading.Thread(target=stranger.serve_forever)
        thread.start()
        assert health.main(["--url", f"http://127.0.0.1:{stranger.server_port}"]) == 1
        assert "must be an attentionvote server" in capsys.readouterr().err
        stranger.shutdown()
        thread.join()


@pytest.mark.parametrize("url", ["127.0.0.1:8000", "ftp://x", "http://", ""])
def test_no_address_is_refused(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert health.main(["--url", url]) == 2
    assert "--url must be http://HOST:PORT" in capsys.readouterr().err
