"""What is asked of a tracking server before anything is written to it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from attentionvote.tracking.store import connect


@contextmanager
def answering(version: str, status: int = 200) -> Iterator[str]:
    """What a real server of MLflow 2.22.0 answered, but for its version: that package cannot stand beside ours."""

    class Answers(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self._answer(b"OK", 200) if self.path == "/health" else self._answer(version.encode(), status)

        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["Content-Length"]))
            self._answer(b"{}", 200)

        def _answer(self, body: bytes, code: int) -> None:
            self.send_response(code)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Answers) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


@pytest.mark.parametrize("version", ["2.22.0", "1.30.1"])
def test_an_old_server_is_named_with_its_version(version: str) -> None:
    with answering(version) as uri, pytest.raises(ConnectionError) as caught:
        connect(uri)
    assert str(caught.value).startswith(f"the tracking server at {uri} must be MLflow 3 or newer, got {version}: ")


@pytest.mark.parametrize(
    ("version", "status"), [("3.0.0", 200), ("3.17.2\n", 200), ("10.1.0rc1", 200), ("2.22.0", 404), ("<html>", 200)]
)
def test_a_new_server_and_one_whose_version_is_hidden_are_taken(version: str, status: int) -> None:
    with answering(version, status) as uri:
        connect(uri)
