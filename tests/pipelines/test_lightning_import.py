"""A shorter import of Lightning leaves SciPy as it was."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

PIPELINES = Path(__file__).resolve().parents[2] / "pipelines"
PROGRAM = """
import sys
from lightning_import import without_scipy_signal
with without_scipy_signal():
    import scipy.signal
    assert hasattr(scipy.signal, "hamming"), "torchmetrics would add it"
print("scipy.signal" in sys.modules)
import scipy.signal
print(scipy.signal.find_peaks([0, 1, 0])[0], hasattr(scipy.signal, "hamming"))
with without_scipy_signal():
    print(hasattr(sys.modules["scipy.signal"], "find_peaks"))
print("scipy.signal" in sys.modules)
"""


def test_scipy_signal_is_left_out_and_still_there_for_who_needs_it() -> None:
    command = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, cwd=PIPELINES, capture_output=True, text=True, timeout=120, check=False)
    assert (done.stdout, done.stderr) == ("False\n[1] False\nTrue\nTrue\n", "")


def test_torchmetrics_still_asks_for_nothing_else() -> None:
    """What the short cut relies on: the name is all that torchmetrics does with the module when it is imported."""
    import torchmetrics

    package = Path(torchmetrics.__file__).parent
    asked = {line.strip() for path in package.rglob("*.py") for line in _lines(path) if "scipy.signal" in line}
    assert asked == {
        "import scipy.signal",
        "# back compatibility patch due to SMRMpy using scipy.signal.hamming",
        'if not hasattr(scipy.signal, "hamming"):',
        "scipy.signal.hamming = scipy.signal.windows.hamming",
    }


def _lines(path: Path) -> list[str]:
    return path.read_text(encoding="utf-8").splitlines()
