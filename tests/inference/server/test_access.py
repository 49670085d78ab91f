"""Tokens and hosts."""

from __future__ import annotations

from pathlib import Path

import pytest

from attentionvote.inference.errors import InputError
from attentionvote.inference.server.access import Tokens, check_host, is_loopback, names_this_machine

SECRET = "s3cret-" + "x" * 20


@pytest.fixture
def token_file(tmp_path: Path) -> Path:
    """A file with two tokens, as while one replaces the other."""
    path = tmp_path / "token"
    path.write_text(f"{SECRET}\n\nother-{SECRET}\n")
    path.chmod(0o600)
    return path


def test_every_line_is_a_token_and_nothing_else_is(token_file: Path) -> None:
    tokens = Tokens(token_file)
    assert tokens.accept(f"Bearer {SECRET}")
    assert tokens.accept(f"bearer other-{SECRET}")
    for wrong in (
        None,
        "",
        "Bearer",
        "Bearer ",
        SECRET,
        f"Basic {SECRET}",
        f"Bearer {SECRET}x",
        f"Bearer {SECRET[:-1]}",
    ):
        assert not tokens.accept(wrong)
    assert not tokens.accept("Bearer \u20ac")
    assert SECRET not in repr(vars(tokens))


def test_a_file_that_others_can_read_is_noticed(token_file: Path) -> None:
    assert not Tokens(token_file).readable_by_others
    token_file.chmod(0o644)
    assert Tokens(token_file).readable_by_others


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "must hold one token a line, got 0 lines"),
        (b" \n\n", "must hold one token a line, got 0 lines"),
        (b"short", "at least 16 printable characters without spaces, line 1 is none: make one with"),
        (SECRET.encode() + b"\nwith a space in the middle", "line 2 is none"),
        (b"\xff" * 20, "line 1 is none"),
        (b"x" * 20_000, "must hold one token a line"),
    ],
)
def test_a_file_without_a_usable_token_is_refused(tmp_path: Path, content: bytes, sentence: str) -> None:
    path = tmp_path / "token"
    path.write_bytes(content)
    with pytest.raises(InputError, match=sentence) as caught:
        Tokens(path)
    assert SECRET not in str(caught.value)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="must be readable, but: No such file"):
        Tokens(tmp_path / "none")


def test_without_a_token_only_the_machine_itself_may_call(token_file: Path) -> None:
    for host in ("127.0.0.1", "127.8.9.1", "::1", "localhost"):
        assert is_loopback(host)
        check_host(host, None)
    for host in ("0.0.0.0", "::", "192.168.1.5", "cell.example", "", "localhost.example", "127.0.0.1.example"):
        assert not is_loopback(host)
        with pytest.raises(InputError, match=r"must be a loopback address .* without --token-file, got"):
            check_host(host, None)
        check_host(host, Tokens(token_file))


@pytest.mark.parametrize("header", ["localhost", "LOCALHOST:8000", "127.0.0.1", "127.8.8.8:1", "[::1]", "[::1]:8000"])
def test_hosts_that_name_this_machine(header: str) -> None:
    assert names_this_machine(header)


@pytest.mark.parametrize(
    "header",
    [
        "",
        "x",
        "evil.example:8000",
        "localhost.evil.example",
        "192.168.0.1",
        "[::2]:80",
        "[::1",
        "user@evil",
        "1.1.1.1#@localhost",
    ],
)
def test_hosts_that_do_not(header: str) -> None:
    assert not names_this_machine(header)
