"""Lightning's import without a third of its time: ``scipy.signal``, which nothing here uses, and collecting garbage."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType


def import_lightning() -> None:
    """Import Lightning; does nothing where that has happened."""
    if "lightning.pytorch" in sys.modules:
        return
    collecting = gc.isenabled()
    gc.disable()  # an import makes a million objects that stay: looking for garbage among them is a tenth of its time
    try:
        with without_scipy_signal():
            import torchmetrics  # noqa: F401
        import lightning.pytorch  # noqa: F401
    finally:
        if collecting:
            gc.enable()


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
    vars(empty)["hamming"] = None
    try:
        yield
    finally:
        del sys.modules["scipy.signal"]
