"""Lightning's import without a quarter of its time: ``scipy.signal``, which nothing here uses."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType


def import_lightning() -> None:
    """Import what Lightning imports of torchmetrics; later imports of Lightning find it."""
    if "torchmetrics" not in sys.modules:
        with without_scipy_signal():
            import torchmetrics  # noqa: F401


@contextmanager
def without_scipy_signal() -> Iterator[None]:
    """Within, ``import scipy.signal`` costs nothing and brings nothing; afterwards it is the real one again.

    torchmetrics imports it for the users of another package only: to give it back a name (``hamming``) that SciPy has
    taken away. It asks whether that name is there.
    """
    if "scipy.signal" in sys.modules:
        yield
        return
    sys.modules["scipy.signal"] = empty = ModuleType("scipy.signal")
    empty.hamming = None  # type: ignore[attr-defined]
    try:
        yield
    finally:
        del sys.modules["scipy.signal"]
