"""The cell's C files under the sanitizers, on clouds of every float32: they end, and stay in their memory."""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
from importlib import resources
from pathlib import Path

import pytest

from attentionvote.geometry.native import PORTABLE

FIXTURES = Path(__file__).resolve().parents[1] / "fixtures"
CLOUDS = 50  # of each of eleven kinds
MOST_CPU_S = 60  # ten times what they take: then a loop does not end
WATCH = """
#include <fenv.h>
void clear(void) { feclearexcept(FE_ALL_EXCEPT); }
int overflowed(void) { return fetestexcept(FE_OVERFLOW | FE_DIVBYZERO | FE_INVALID); }
"""
BLIND = "void clear(void) {} int overflowed(void) { return 0; }"  # optimised code computes what it then does not use
CHECKS = "-fsanitize=address,undefined,float-cast-overflow,float-divide-by-zero"
SANITIZERS = ["-O1", "-g", CHECKS, "-fno-sanitize-recover=all"]


@pytest.fixture
def runtime() -> str:
    """The address sanitizer's library, which must be loaded before all others."""
    if shutil.which("cc") is None:
        pytest.skip("no C compiler on this machine")
    found = subprocess.run(["cc", "-print-file-name=libasan.so"], capture_output=True, text=True, check=True)
    if not Path(found.stdout.strip()).is_absolute():
        pytest.skip("the C compiler of this machine has no address sanitizer")
    return found.stdout.strip()


def limit_processor_time() -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (MOST_CPU_S, MOST_CPU_S))


@pytest.mark.timeout(300)
@pytest.mark.parametrize("watched", [True, False], ids=["sanitized", "as shipped"])
def test_c_files_end_stay_in_their_memory_and_equal_their_references(
    runtime: str, tmp_path: Path, watched: bool
) -> None:
    (tmp_path / "watch.c").write_text(WATCH if watched else BLIND)
    sources = [str(resources.files("attentionvote.geometry").joinpath(name)) for name in ("pointops.c", "normals.c")]
    library = tmp_path / "library.so"
    flags = [*PORTABLE, *(SANITIZERS if watched else [])]
    subprocess.run(["cc", *flags, *sources, str(tmp_path / "watch.c"), "-o", str(library), "-lm"], check=True)
    done = subprocess.run(
        [sys.executable, str(FIXTURES / "geometry_fuzz.py"), str(library), str(CLOUDS)],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=limit_processor_time,
        env={**os.environ, "OMP_NUM_THREADS": "1", "ASAN_OPTIONS": "detect_leaks=0"}
        | ({"LD_PRELOAD": runtime} if watched else {}),
    )
    assert done.returncode == 0, f"exit code {done.returncode}: {done.stderr[-3000:]}"
    rows = [line.split("\t") for line in done.stdout.splitlines()]
    calls = {kind: (int(served), int(refused)) for kind, served, refused in rows}
    assert len(calls) == 11
    for kind, (served, refused) in calls.items():
        assert served + refused >= 5 * CLOUDS, kind
        if kind in ("measured", "subnormal", "widest lattice") or kind.endswith("that C serves"):
            assert refused == 0, kind  # else the references would have been compared with themselves
    assert calls["some at the largest number"][1] > 0
