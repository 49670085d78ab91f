"""A real MLflow server as a registry, and a gate before it that can look, change, hold up and cut off."""

from __future__ import annotations

import datetime
import http.server
import ipaddress
import os
import signal
import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from attentionvote.inference.bundles.bundle import load_bundle


@dataclass
class RealRegistry:
    """A running MLflow server and its store."""

    url: str
    store: str
    process: Any
    models: int = 0

    def new_name(self) -> str:
        """Of a registered model that no other test has; without our prefix, so that any part may be in it."""
        self.models += 1
        return f"model-{self.models}"

    def register(self, name: str, folder: Path, alias: str | None = "champion", digest: str | None = None) -> str:
        """Register a bundle as `make promote` does; its version.

        Args:
            name: of the registered model.
            folder: the bundle's.
            alias: that is moved to the version; None: none.
            digest: of the tag; None: the bundle's own, empty: no tag.
        """
        import mlflow

        from attentionvote.tracking.store import connect, experiment_id

        client = connect(self.store)
        mlflow.set_tracking_uri(self.store)  # the registry looks logged models up through the global client
        if digest is None:
            digest = load_bundle(folder, None).digest
        experiment = experiment_id(client, self.store, "cells")
        run = client.create_run(experiment)
        model = client.create_logged_model(experiment, name="bundle", source_run_id=run.info.run_id)
        client.log_model_artifacts(model.model_id, str(folder))
        client.finalize_logged_model(model.model_id, "READY")
        if not client.search_registered_models(f"name = '{name}'"):
            client.create_registered_model(name)
        version = client.create_model_version(
            name,
            f"models:/{model.model_id}",
            run_id=run.info.run_id,
            model_id=model.model_id,
            tags={"bundle.digest": digest} if digest else {},
        )
        if alias is not None:
            client.set_registered_model_alias(name, alias, version.version)
        return str(version.version)

    def move(self, name: str, alias: str, version: str) -> None:
        """Move an alias."""
        from attentionvote.tracking.store import connect

        connect(self.store).set_registered_model_alias(name, alias, version)

    def kill(self) -> None:
        """kill -9 of the server and its children."""
        os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait(10)


@contextmanager
def running_registry(store: str) -> Iterator[RealRegistry]:
    """A server on a store."""
    from attentionvote.tracking.server import serve

    with serve(store) as server:
        yield RealRegistry(server.url, server.store, server.process)


@pytest.fixture(scope="session")
def real_registry(
    put_tables: Callable[[Path], str], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[RealRegistry]:
    """A server that the tests of a session share: each has models of its own in it."""
    with running_registry(put_tables(tmp_path_factory.mktemp("registry") / "mlflow.db")) as registry:
        yield registry


@pytest.fixture
def own_registry(put_tables: Callable[[Path], str], tmp_path: Path) -> Iterator[RealRegistry]:
    """A server of this test alone, which may kill it."""
    with running_registry(put_tables(tmp_path / "registry" / "mlflow.db")) as registry:
        yield registry


@dataclass
class Gate:
    """Stands before the real server.

    Attributes:
        url: its own address.
        asked: what was asked for: paths with queries, in order.
        authorizations: the headers that came with them.
        demanded: the header that must come; others get 401.
        change: makes another body of a good answer to a path.
        status: answers this instead of asking the server.
        location: sends everybody there.
        stop_after: bytes of a body after which the answer stands still until ``go_on`` is set.
        cut: end the connection there instead.
    """

    url: str = ""
    asked: list[str] = field(default_factory=list)
    authorizations: list[str | None] = field(default_factory=list)
    demanded: str | None = None
    change: Callable[[str, bytes], bytes] | None = None
    status: int | None = None
    location: str | None = None
    stop_after: Callable[[str], int | None] = lambda _: None
    cut: bool = False
    stopped: threading.Event = field(default_factory=threading.Event)
    go_on: threading.Event = field(default_factory=threading.Event)

    def files(self) -> list[str]:
        """The names of the files that were asked for."""
        return [path.partition("&path=")[2].replace("%2F", "/") for path in self.asked if "get-artifact" in path]


def handler_of(gate: Gate, target: str) -> type[http.server.BaseHTTPRequestHandler]:
    """The gate's handler."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            gate.asked.append(self.path)
            gate.authorizations.append(self.headers["Authorization"])
            if gate.location is not None:
                self.answer(302, b"", {"Location": gate.location + self.path})
            elif gate.status is not None:
                self.answer(gate.status, b'{"error_code": "INTERNAL_ERROR"}')
            elif gate.demanded is not None and self.headers["Authorization"] != gate.demanded:
                self.answer(401, b"You are not authenticated.")
            else:
                try:
                    with urllib.request.urlopen(target + self.path, timeout=20) as reply:
                        status, body = reply.status, reply.read()
                except urllib.error.HTTPError as error:
                    with error:
                        status, body = error.code, error.read()
                if status == 200 and gate.change is not None:
                    body = gate.change(self.path, body)
                self.answer(status, body)

        def answer(self, status: int, body: bytes, headers: dict[str, str] | None = None) -> None:
            self.send_response(status)
            for name, value in {"Content-Length": str(len(body)), **(headers or {})}.items():
                self.send_header(name, value)
            self.end_headers()
            stop = gate.stop_after(self.path)
            if stop is not None:
                self.wfile.write(body[:stop])
                self.wfile.flush()
                gate.stopped.set()
                if gate.cut:
                    return
                gate.go_on.wait(30)
                body = body[stop:]
            try:
                self.wfile.write(body)
            except OSError:  # whoever asked was killed
                self.close_connection = True

        def log_message(self, *_: object) -> None:
            """Nothing."""

    return Handler


@pytest.fixture
def gate(real_registry: RealRegistry) -> Iterator[Gate]:
    """A gate before the shared server."""
    made = Gate()
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler_of(made, real_registry.url)) as server:
        made.url = f"http://127.0.0.1:{server.server_port}"
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            yield made
        finally:
            made.go_on.set()
            server.shutdown()
            thread.join()


def make_certificate(folder: Path) -> tuple[Path, Path]:
    """A certificate of 127.0.0.1 and its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "cell")])
    now = datetime.datetime.now(datetime.UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(minutes=1))
        .not_valid_after(now + datetime.timedelta(hours=1))
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    encoding, form = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
    cert_file, key_file = folder / "cert.pem", folder / "key.pem"
    cert_file.write_bytes(made.public_bytes(encoding))
    key_file.write_bytes(key.private_bytes(encoding, form, serialization.NoEncryption()))
    (folder / "locked.pem").write_bytes(
        key.private_bytes(encoding, form, serialization.BestAvailableEncryption(b"password"))
    )
    return cert_file, key_file


@pytest.fixture(scope="session")
def certificate() -> Callable[[Path], tuple[Path, Path]]:
    """Writes a certificate of 127.0.0.1 and its key into a folder, and the key with a password as ``locked.pem``."""
    return make_certificate


@pytest.fixture
def free_port() -> int:
    """A TCP port of the loopback interface where nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
