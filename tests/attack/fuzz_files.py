"""Damaged scans of every kind, read in this process; only arrays and single sentences may come out.

``python tests/attack/fuzz_files.py --count 1000000 --seed 0`` writes progress to stderr and one line of JSON to stdout;
exit code 1 when anything else came out. ``--seed N --count 1`` does one file again.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import time
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / "fixtures"), str(Path(__file__).resolve().parents[2] / "src")]

from scan_mutations import complaint, damaged_file  # noqa: E402

from attentionvote.geometry import native  # noqa: E402

_MOST_COUNT, _MOST_KEPT, _PROGRESS_S = 100_000_000, 20, 5.0


def main() -> int:
    """Read the damaged files; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000, help="files")
    parser.add_argument("--seed", type=int, default=0, help="of the first file; the next one has the next")
    parser.add_argument("--python", action="store_true", help="without the compiled code")
    options = parser.parse_args()
    if not 0 < options.count <= _MOST_COUNT:
        parser.error(f"--count must be between 1 and {_MOST_COUNT}, got {options.count}")
    if not options.python and native.load("attentionvote.inference.scans", "scan_bytes.c") is None:
        parser.error("the compiled code must be there, but it is not: install gcc, or give --python")
    if options.python:
        with native.disabled():
            return _run(options.count, options.seed)
    return _run(options.count, options.seed)


def _run(count: int, seed: int) -> int:
    start, last, wrong, examples = time.monotonic(), time.monotonic(), 0, []
    spent, before = time.process_time(), _peak_mib()
    for i in range(count):
        if sentence := complaint(damaged_file(seed + i)):
            wrong += 1
            if len(examples) < _MOST_KEPT:
                examples.append({"seed": seed + i, "complaint": sentence[:400]})
        if (now := time.monotonic()) - last > _PROGRESS_S:
            last = now
            print(f"{i + 1} of {count}, {wrong} wrong, {(i + 1) / (now - start):.0f} a second", file=sys.stderr)
    seconds = time.monotonic() - start
    result = {
        "files": count,
        "seed": seed,
        "wrong": wrong,
        "examples": examples,
        "files_per_second": round(count / seconds),
        "files_per_processor_second": round(count / (time.process_time() - spent)),
        "peak_mib_before": before,
        "peak_mib": _peak_mib(),
    }
    print(json.dumps(result))
    return 1 if wrong else 0


def _peak_mib() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


if __name__ == "__main__":
    sys.exit(main())
