"""Every built-in part is one convex piece here."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture(scope="module", autouse=True)
def _quick_pieces(parts_of_one_piece: Path) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ATTENTIONVOTE_CACHE", str(parts_of_one_piece))
        yield
