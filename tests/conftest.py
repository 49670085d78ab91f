"""What every test shares: one thread, no display, the check data beside the repository."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

# Before numpy or torch is imported: tests run side by side, each on one thread, and need no window.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"
os.environ["MPLBACKEND"] = "Agg"
# A shell that starts the tests in the background has Ctrl-C ignored, and children would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # and so it is with SIGHUP below nohup

import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

# The same examples in every run: a red test is red for everybody. Timing is not what properties are about.
settings.register_profile("project", deadline=None, derandomize=True)
settings.load_profile("project")

# Fixtures that several folders of tests share, and how the tests are distributed.
pytest_plugins = [
    "bop_split", "box_scenes", "brick_models", "databases", "distribution", "environment", "one_piece_parts",
    "quick_training", "real_servers", "tiny_bundle", "work_trees",
]  # fmt: skip
ROOT = Path(__file__).resolve().parents[1]
SHARED_DATA = ROOT / ".." / "shared" / "data"


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the repository."""
    return ROOT


@pytest.fixture(scope="session")
def shared_data() -> Callable[[str], Path]:
    """The path of one file or folder of the check data, which is never committed; skips where it is absent."""

    def find(name: str) -> Path:
        path = SHARED_DATA / name
        if not path.exists():
            pytest.skip(f"the check data is not on this machine: ../shared/data/{name}")
        return path

    return find
