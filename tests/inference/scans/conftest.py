"""Reading with the compiled code, as a cell's image has it, and without."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from attentionvote.geometry import native


@pytest.fixture(scope="session", autouse=True)
def compiled_code() -> None:
    """The C code is there, whichever test runs first."""
    assert native.load("attentionvote.inference.scans", "scan_bytes.c") is not None


@pytest.fixture(params=["compiled", "python"])
def way(request: pytest.FixtureRequest) -> Iterator[str]:
    """A test twice: with the C code and without."""
    if request.param == "python":
        with native.disabled():
            yield request.param
    else:
        yield request.param
