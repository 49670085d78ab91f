"""A user without a home: containers run as a number that no file knows."""

from __future__ import annotations

import os
import pwd
from pathlib import Path

import pytest

from attentionvote.files import cache_folder
from attentionvote.geometry import native
from attentionvote.inference.bundles.signature import KEYS_VARIABLE, keys_folder
from attentionvote.inference.errors import InputError
from attentionvote.inference.home_folder import home_folder


def test_the_variable_comes_first(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert home_folder("SOME_FOLDER", ".config", "--key") == tmp_path / ".config" / "attentionvote"
    monkeypatch.setenv("SOME_FOLDER", "~/elsewhere")
    assert home_folder("SOME_FOLDER", ".config", "--key") == tmp_path / "elsewhere"


@pytest.fixture
def homeless(monkeypatch: pytest.MonkeyPatch) -> None:
    """No HOME, and a user that the system's list does not name."""

    def unknown(uid: int) -> None:
        raise KeyError(f"getpwuid(): uid not found: {uid}")

    for name in ("HOME", "XDG_CACHE_HOME", "ATTENTIONVOTE_CACHE", KEYS_VARIABLE):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", unknown)


@pytest.mark.usefixtures("homeless")
def test_a_user_without_a_home_gets_a_sentence() -> None:
    with pytest.raises(RuntimeError):
        Path.home()
    with pytest.raises(InputError, match="must have a home folder, or --key or ATTENTIONVOTE_KEYS must be set"):
        keys_folder()


@pytest.mark.usefixtures("homeless")
def test_compiled_code_is_looked_for_where_nobody_else_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    assert cache_folder() == Path(f"/run/user/{os.getuid()}/attentionvote")
    assert native.load("attentionvote.geometry", "normals.c", make=False) is None
    monkeypatch.setenv("ATTENTIONVOTE_CACHE", "")  # not the current folder
    assert cache_folder().is_absolute()
