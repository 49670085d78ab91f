"""Address and credentials of a registry: where they come from, and that they are shown nowhere."""

from __future__ import annotations

import argparse
import base64
from pathlib import Path

import pytest

from attentionvote.inference.errors import InputError
from attentionvote.inference.fetching import access as registry_access
from attentionvote.inference.fetching.access import Access, access, checked_address

VARIABLES = ("MLFLOW_TRACKING_URI", "MLFLOW_TRACKING_USERNAME", "MLFLOW_TRACKING_PASSWORD")
CREDENTIALS = "cell:pass:wörd"
HEADER = "Basic " + base64.b64encode(CREDENTIALS.encode()).decode()


@pytest.fixture(autouse=True)
def _no_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)


def given(*words: str | Path) -> Access:
    parser = argparse.ArgumentParser()
    registry_access.add_arguments(parser)
    return access(parser.parse_args([str(word) for word in words]))


def test_option_and_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"needs its registry, got none: give --registry .* MLFLOW_TRACKING_URI"):
        given()
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://mlflow:5000/")
    assert given() == Access("http://mlflow:5000")
    assert given("--registry", "https://other/below/").url == "https://other/below"
    monkeypatch.setenv("MLFLOW_TRACKING_USERNAME", "cell")
    with pytest.raises(InputError, match="got MLFLOW_TRACKING_USERNAME only: set MLFLOW_TRACKING_PASSWORD"):
        given()
    monkeypatch.setenv("MLFLOW_TRACKING_PASSWORD", "pass:wörd")
    assert given().authorization == HEADER
    file = tmp_path / "credentials"
    file.write_text("other:one\n", encoding="utf-8")
    file.chmod(0o600)
    found = given("--registry-auth-file", file)
    assert found.authorization == "Basic " + base64.b64encode(b"other:one").decode()
    assert not found.readable_by_others
    assert found.open_to_listeners
    assert found.host == "mlflow"
    file.chmod(0o644)
    assert given("--registry-auth-file", file, "--registry", "https://x").readable_by_others
    assert not given("--registry-auth-file", file, "--registry", "https://x").open_to_listeners
    assert HEADER not in repr(given())
    assert HEADER[6:] not in repr(given())


@pytest.mark.parametrize("url", ["http://cell:hunter2@mlflow:5000", "cell:hunter2@mlflow:5000", "https://hunter2@x"])
def test_credentials_in_an_address_are_refused_and_not_repeated(url: str) -> None:
    with pytest.raises(InputError, match=r"must not hold credentials.*--registry-auth-file") as caught:
        given("--registry", url)
    assert "hunter2" not in str(caught.value)


@pytest.mark.parametrize(
    "url", ["mlflow:5000", "sqlite:///mlflow.db", "http://", "ftp://x", "http://x:y", "http://x:99999", "http://x?a=1",
            "http://x#a", "http://x /", "http://x\n", "http://ü"]
)  # fmt: skip
def test_other_addresses_are_refused(url: str) -> None:
    with pytest.raises(InputError, match=r"must be http://HOST:PORT or https://HOST:PORT, got '.*`mlflow server`"):
        checked_address(url)


@pytest.mark.parametrize(
    "content", [b"", b"\n", b"user", b"user:", b":word", b"a:b\nc:d\n", b"a:\xff", b"a:b\x07", b"a:" + b"b" * 9999]
)
def test_a_file_without_credentials_is_refused_and_not_repeated(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "credentials"
    file.write_bytes(content)
    with pytest.raises(InputError, match="must hold one line user:password") as caught:
        given("--registry", "http://x", "--registry-auth-file", file)
    assert "word" not in str(caught.value).replace("user:password", "")


def test_a_file_that_is_missing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="none must be readable, but: No such file"):
        given("--registry", "http://x", "--registry-auth-file", tmp_path / "none")
