"""What the registry's tests share: the versions of one part's model in a fresh store, on SQLite and on PostgreSQL."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from attentionvote.inference import Bundle, load_bundle
from attentionvote.registry.history import History
from attentionvote.registry.versions import Versions


@pytest.fixture
def versions(database: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Versions:
    """Of the part ``bracket``; artefacts of a database without a server lie in the working directory."""
    monkeypatch.chdir(tmp_path)
    return Versions(database, "bracket")


@pytest.fixture
def history(versions: Versions) -> History:
    return History(versions)


@pytest.fixture
def make_model(make_bundle, trusted_key: Path) -> Callable[[float], Bundle]:
    """A verified bundle that is a model of its own for every threshold."""

    def make(threshold: float = 0.5) -> Bundle:
        return load_bundle(make_bundle(f"bundle_{threshold}", card={"confidence_threshold": threshold}), trusted_key)

    return make
