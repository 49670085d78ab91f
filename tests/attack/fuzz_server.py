"""Damaged scans of every kind sent to a real server; each must be answered in one sentence or with poses.

``python tests/attack/fuzz_server.py BUNDLE --key signing.pub --count 50000 --seed 0``: the file of a seed is that of
``fuzz_files.py``. One line of JSON on stdout; exit code 1 when one was answered otherwise, or a worker was lost.
"""

from __future__ import annotations

import argparse
import http.client
import json
import sys
import time
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / name) for name in ("tests/fixtures", "src", "pipelines")]

from scan_mutations import damaged_file  # noqa: E402

from attentionvote.workflows.speed.serving import server  # noqa: E402

_MOST_COUNT, _PROGRESS_S, _MOST_EXAMPLES = 10_000_000, 5.0, 20


def main() -> int:
    """Send the files; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--key", type=Path, required=True, help="public key of the bundle")
    parser.add_argument("--count", type=int, default=50_000, help="files, default 50000")
    parser.add_argument("--seed", type=int, default=0, help="of the first file; the next one has the next")
    options = parser.parse_args()
    if not 0 < options.count <= _MOST_COUNT:
        parser.error(f"--count must be between 1 and {_MOST_COUNT}, got {options.count}")
    with server(options.bundle, options.key, 2) as url:
        result = fuzz(url.removeprefix("http://"), options.count, options.seed)
    print(json.dumps(result))
    return int(bool(result["wrong"] or result["workers_lost"]))


def fuzz(address: str, count: int, seed: int) -> dict[str, object]:
    """What a server answered to so many files, from that seed on."""
    connection = http.client.HTTPConnection(address, timeout=30)
    _wait_until_ready(connection)
    statuses: Counter[int] = Counter()
    examples, slowest, start = [], 0.0, time.monotonic()
    last = start
    for i in range(seed, seed + count):
        begun = time.monotonic()
        complaint = _complaint(connection, damaged_file(i), statuses)
        now = time.monotonic()
        slowest = max(slowest, now - begun)
        if complaint and len(examples) < _MOST_EXAMPLES:
            examples.append({"seed": i, "complaint": complaint})
        if now - last > _PROGRESS_S:
            last = now
            print(f"{i - seed + 1} of {count}, {dict(statuses)}, {len(examples)} wrong", file=sys.stderr)
    connection.request("GET", "/metrics")
    lines = connection.getresponse().read().decode().splitlines()
    lost = sum(float(line.split()[1]) for line in lines if line.startswith("attentionvote_workers_lost_total"))
    return {
        "files": count,
        "seed": seed,
        "wrong": len(examples),
        "examples": examples,
        "statuses": dict(statuses),
        "workers_lost": int(lost),
        "slowest_ms": round(1e3 * slowest, 1),
        "files_per_second": round(count / (time.monotonic() - start)),
    }


def _complaint(connection: http.client.HTTPConnection, body: bytes, statuses: Counter[int]) -> str:
    """What is wrong with the answer to a file; empty when nothing is."""
    connection.request("POST", "/poses", body)
    response = connection.getresponse()
    content = response.read()
    statuses[response.status] += 1
    try:
        answer = json.loads(content)
    except ValueError:
        return f"status {response.status} and no JSON"
    if response.status == 200:
        return "" if isinstance(answer["poses"], list) else "no list of poses"
    sentence = answer.get("error", "")
    if response.status != 400 or not sentence or "\n" in sentence or "Traceback" in sentence:
        return f"status {response.status}: {sentence[:200]!r}"
    return ""


def _wait_until_ready(connection: http.client.HTTPConnection) -> None:
    until = time.monotonic() + 60
    while time.monotonic() < until:
        connection.request("GET", "/v2/health/ready")
        response = connection.getresponse()
        response.read()
        if response.status == 200:
            return
        time.sleep(0.2)
    raise TimeoutError("the server must be ready within 60 s, but it is not")


if __name__ == "__main__":
    sys.exit(main())
