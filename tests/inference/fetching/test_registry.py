"""The registry's client against a real MLflow server: what a reference names, refusals, credentials, bounds."""

from __future__ import annotations

import base64
import http.server
import re
import ssl
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from attentionvote.inference.bundles.bundle import load_bundle
from attentionvote.inference.errors import BundleError, RegistryError
from attentionvote.inference.fetching.access import Access
from attentionvote.inference.fetching.reference import RegistryVersion, parse_reference
from attentionvote.inference.fetching.registry import Registry

Make = Callable[..., Path]
pytestmark = pytest.mark.slow  # the first one starts an MLflow server


def resolved(url: str, reference: str, **access: Any) -> RegistryVersion:
    return Registry(Access(url, **access), timeout_s=5).resolve(parse_reference(reference))


def content(registry: Registry, version: RegistryVersion, name: str, most: int = 10**7) -> bytes:
    return b"".join(registry.pieces(version, name, most))


def test_alias_and_pin_name_a_version_and_every_file_can_be_read(real_registry: Any, make_bundle: Make) -> None:
    name = real_registry.new_name()
    first, second = make_bundle("first"), make_bundle("second", card={"evaluation": {"ap": 0.8}})
    assert real_registry.register(name, first) == "1"
    assert real_registry.register(name, second) == "2"
    digests = [load_bundle(folder, None).digest for folder in (first, second)]
    newest = resolved(real_registry.url, f"models:/{name}@champion")
    assert newest == RegistryVersion(name, "2", digests[1])
    assert resolved(real_registry.url + "/", f"models:/{name}/1") == RegistryVersion(name, "1", digests[0])
    registry = Registry(Access(real_registry.url))
    for file in (path for path in second.rglob("*") if path.is_file()):
        assert content(registry, newest, file.relative_to(second).as_posix()) == file.read_bytes()
    with pytest.raises(BundleError, match=f"version 2 of {name} must hold golden/none.npz, but there is none"):
        content(registry, newest, "golden/none.npz")
    size = (second / "model.onnx").stat().st_size
    assert len(content(registry, newest, "model.onnx", size)) == size
    with pytest.raises(BundleError, match=f"model.onnx must have at most {size - 1} bytes, got more"):
        content(registry, newest, "model.onnx", size - 1)


def test_what_is_not_there_is_named_with_the_nearest_choice(real_registry: Any, make_bundle: Make) -> None:
    name = real_registry.new_name()
    folder = make_bundle()
    real_registry.register(name, folder)
    real_registry.register(name, folder, alias=None, digest="")
    for reference, sentence in (
        (f"models:/{name}@chmapion", f"{name} must have the alias chmapion, but there is none, did you mean champion?"),
        (f"models:/{name}@zzz", f"{name} must have the alias zzz, but there is none: there is champion"),
        (f"models:/{name}/9", f"{name} must have a version 9, but there is none: there are 2, 1"),
        (f"models:/{name}x@champion", f"must have a model {name}x, but there is none, did you mean {name}?"),
        (f"models:/{name}x/1", f"must have a model {name}x, but there is none, did you mean {name}?"),
    ):
        with pytest.raises(RegistryError, match=re.escape(sentence)) as caught:
            resolved(real_registry.url, reference)
        assert not caught.value.away
    with pytest.raises(BundleError, match=r"version 2 of .* must have the tag bundle.digest .* got ''"):
        resolved(real_registry.url, f"models:/{name}/2")


def test_a_name_that_the_server_does_not_answer_to_is_said(real_registry: Any) -> None:
    port = real_registry.url.rpartition(":")[2]
    with pytest.raises(RegistryError, match=rf"Invalid Host header\): start it with --allowed-hosts 127\.1:{port}"):
        resolved(f"http://127.1:{port}", "models:/gear@champion")  # the same address by another name


def test_credentials_are_sent_and_a_refusal_does_not_show_them(
    gate: Any, real_registry: Any, make_bundle: Make
) -> None:
    name = real_registry.new_name()
    real_registry.register(name, make_bundle())
    right = "Basic " + base64.b64encode(b"cell:secret word").decode()
    gate.demanded = right
    assert resolved(gate.url, f"models:/{name}@champion", authorization=right).version == "1"
    assert gate.authorizations == [right]
    for other in (None, "Basic d3Jvbmc6d3Jvbmc="):
        with pytest.raises(RegistryError, match=r"must know who asks, .*\(401\)") as caught:
            resolved(gate.url, f"models:/{name}@champion", authorization=other)
        assert "d3Jvbmc" not in str(caught.value)
    assert "Basic" not in repr(Access(gate.url, right))


def test_another_host_gets_neither_question_nor_credentials(gate: Any, real_registry: Any) -> None:
    gate.location = real_registry.url  # another port is another address
    with pytest.raises(RegistryError, match=r"redirects to another address, http://127.0.0.1, which is not followed"):
        resolved(gate.url, "models:/gear@champion", authorization="Basic eDp5")
    assert len(gate.asked) == 1


def test_proxies_of_the_environment_are_not_asked(
    real_registry: Any, make_bundle: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = real_registry.new_name()
    real_registry.register(name, make_bundle())
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    assert resolved(real_registry.url, f"models:/{name}@champion").version == "1"


def test_what_is_away_is_told_apart_from_what_refuses(gate: Any, free_port: int) -> None:
    with pytest.raises(RegistryError, match=rf"127.0.0.1:{free_port} cannot be reached: Connection refused") as caught:
        resolved(f"http://127.0.0.1:{free_port}", "models:/gear@champion")
    assert caught.value.away
    for status, away in ((503, True), (429, True), (500, True), (418, False), (403, False)):
        gate.status = status
        with pytest.raises(RegistryError, match=str(status)) as caught:
            resolved(gate.url, "models:/gear@champion")
        assert caught.value.away == away, status


def test_an_answer_that_is_cut_off_or_never_ends_is_the_registrys_fault(
    gate: Any, real_registry: Any, make_bundle: Make
) -> None:
    name = real_registry.new_name()
    real_registry.register(name, make_bundle())
    reference = parse_reference(f"models:/{name}@champion")
    gate.stop_after = lambda _: 20
    with pytest.raises(RegistryError, match="cannot be reached: timed out") as caught:
        Registry(Access(gate.url), timeout_s=0.3).resolve(reference)
    assert caught.value.away
    gate.cut = True
    with pytest.raises(RegistryError, match="ended an answer before it was whole") as caught:
        Registry(Access(gate.url)).resolve(reference)
    assert caught.value.away


@pytest.mark.parametrize(
    "body", [b"<html>", b"[]", b'{"model_version": {"name": "x"}}', b"[" * 100_000, b" " * (5 * 1024 * 1024)]
)
def test_another_kind_of_answer_is_refused(gate: Any, real_registry: Any, make_bundle: Make, body: bytes) -> None:
    name = "strange-answers"
    if not hasattr(real_registry, "strange"):
        real_registry.strange = real_registry.register(name, make_bundle())
    gate.change = lambda _, __: body
    with pytest.raises(RegistryError, match="must be an MLflow server, got another kind of answer"):
        resolved(gate.url, f"models:/{name}@champion")


def test_a_certificate_that_the_system_does_not_know_is_refused(certificate: Any, tmp_path: Path) -> None:
    cert, key = certificate(tmp_path)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(cert, key)
    with http.server.HTTPServer(("127.0.0.1", 0), http.server.BaseHTTPRequestHandler) as server:
        server.handle_error = lambda *_: None  # type: ignore[method-assign]
        server.socket = context.wrap_socket(server.socket, server_side=True)
        thread = threading.Thread(target=server.handle_request)
        thread.start()
        with pytest.raises(RegistryError, match=r"its certificate is not trusted .* SSL_CERT_FILE"):
            resolved(f"https://127.0.0.1:{server.server_port}", "models:/gear@champion")
        thread.join()
