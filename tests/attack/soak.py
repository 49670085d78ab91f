"""A server attacked from all sides at once while a good client measures: bounded in time, loopback only.

``python tests/attack/soak.py BUNDLE --key signing.pub --seconds 600``: silent and dripping clients, damaged scans,
bombs, workers that are stopped or killed, and model swaps; the good client compares every answer with an estimator's.
One line of JSON on stdout; exit code 1 when an answer was wrong, lost, or later than 3 s after a fault, or memory grew.
"""

from __future__ import annotations

import argparse
import http.client
import json
import random
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / name) for name in ("tests/attack", "tests/fixtures", "src", "pipelines")]

import numpy as np  # noqa: E402
from attackers import ATTACKS, child_processes, stopped_workers, swaps  # noqa: E402

from attentionvote.inference.bundles.manifest import write_manifest  # noqa: E402
from attentionvote.inference.bundles.signature import load_private_key, make_keys  # noqa: E402
from attentionvote.inference.client import DeadlinePassed, PoseClient, PoseClientError, Unavailable  # noqa: E402
from attentionvote.workflows.speed.serving import Expected, expectations  # noqa: E402

LATEST_S = 3.0
_WARM_S, _LOOK_S, _GROWTH = 20.0, 2.0, 1.25


@dataclass
class Watch:
    """What the good client and the health check saw."""

    seconds: list[float] = field(default_factory=list)
    gaps: list[float] = field(default_factory=list)
    health: list[float] = field(default_factory=list)
    memory: list[tuple[float, float]] = field(default_factory=list)
    wrong: int = 0
    late: int = 0
    lost: Counter[str] = field(default_factory=Counter)


def main() -> int:
    """Attack; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--key", type=Path, required=True, help="public key of the bundle")
    parser.add_argument("--seconds", type=float, default=600.0, help="default 600, at most 7200")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if not 10 <= options.seconds <= 7200:
        parser.error(f"--seconds must be between 10 and 7200, got {options.seconds:g}")
    with tempfile.TemporaryDirectory(prefix="soak-") as folder:
        result = soak(options.bundle, options.key, options.seconds, options.seed, Path(folder))
    print(json.dumps(result))
    return int(bool(result["problems"]))


def soak(bundle: Path, key: Path, seconds: float, seed: int, folder: Path) -> dict[str, Any]:
    """The figures of an attack, with ``problems``: sentences about what should not have been."""
    expected = expectations(bundle, key)
    private, public = make_keys(folder / "keys")
    variants = [_resigned(bundle, folder / name, private, name) for name in ("one", "other")]
    link = folder / "latest"
    link.symlink_to(variants[0])
    words = [str(link), "--key", str(public), "--port", "0", "--state", str(folder / "state"), "--poll-s", "0.5"]
    with (folder / "server.log").open("wb") as log:
        server = subprocess.Popen(
            [sys.executable, "-m", "attentionvote.inference.command_line", "serve", *words],
            stdout=subprocess.PIPE,
            stderr=log,
            start_new_session=True,
        )
    assert server.stdout is not None
    stop = threading.Event()
    watch, counts = Watch(), {name: Counter[str]() for name in (*ATTACKS, "workers", "swaps")}
    try:
        url = str(json.loads(server.stdout.readline())["url"])
        with PoseClient(url, timeout_s=60) as client:
            client.estimate(expected[0].points)
        threads = _threads(url, server.pid, link, variants, expected, stop, watch, counts, seed)
        for thread in threads:
            thread.start()
        _look(server.pid, stop, watch, seconds)
        for thread in threads:
            thread.join(60)
    finally:
        stop.set()
        server.terminate()
        code = server.wait(30)
        server.stdout.close()
    log_text = (folder / "server.log").read_text(encoding="utf-8")
    return _result(watch, counts, seconds, seed, code, log_text)


def _resigned(bundle: Path, folder: Path, private: Path, name: str) -> Path:
    """A copy of a bundle with another digest and the same answers."""
    shutil.copytree(bundle.resolve(), folder)
    with (folder / "part.ply").open("r+b") as file:
        content = file.read().replace(b"\n", f"\ncomment {name}\n".encode(), 1)
        file.seek(0)
        file.write(content)
    for file in ("manifest.json", "manifest.sig"):
        (folder / file).unlink(missing_ok=True)
    write_manifest(folder, load_private_key(private))
    return folder


def _threads(
    url: str,
    pid: int,
    link: Path,
    variants: list[Path],
    expected: list[Expected],
    stop: threading.Event,
    watch: Watch,
    counts: dict[str, Counter[str]],
    seed: int,
) -> list[threading.Thread]:
    host, _, port = url.removeprefix("http://").partition(":")
    arguments: list[tuple[Any, ...]] = [
        (attack, host, int(port), stop, counts[name], random.Random(seed + i))
        for i, (name, attack) in enumerate(ATTACKS.items())
    ]
    arguments += [
        (stopped_workers, pid, stop, counts["workers"], random.Random(seed + 100)),
        (swaps, link, variants, stop, counts["swaps"]),
        (_good_client, url, expected, stop, watch),
        (_health, host, int(port), stop, watch),
    ]
    return [threading.Thread(target=words[0], args=words[1:], daemon=True) for words in arguments]


def _good_client(url: str, expected: list[Expected], stop: threading.Event, watch: Watch) -> None:
    """A cell's controller: a scan after the other, each answer compared; how long it goes without one."""
    last, turn = time.monotonic(), 0
    with PoseClient(url, timeout_s=2.0) as client:
        while not stop.is_set():
            asked = expected[turn % len(expected)]
            turn += 1
            begun = time.monotonic()
            try:
                answer = client.estimate(asked.points)
            except (DeadlinePassed, Unavailable):
                watch.late += 1
                continue
            except PoseClientError as error:
                watch.lost[f"{type(error).__name__}: {error}"[:120]] += 1
                continue
            now = time.monotonic()
            watch.wrong += not asked.fits(answer)
            watch.seconds.append(now - begun)
            watch.gaps.append(now - last)
            last = now
            stop.wait(0.05)


def _health(host: str, port: int, stop: threading.Event, watch: Watch) -> None:
    """What a container's health check asks, on a connection of its own each time."""
    while not stop.wait(0.5):
        begun = time.monotonic()
        try:
            connection = http.client.HTTPConnection(host, port, timeout=5)
            connection.request("GET", "/v2/health/live")
            assert connection.getresponse().status == 200
            connection.close()
            watch.health.append(time.monotonic() - begun)
        except (OSError, http.client.HTTPException, AssertionError) as error:
            watch.lost[f"health: {type(error).__name__}"] += 1


def _look(pid: int, stop: threading.Event, watch: Watch, seconds: float) -> None:
    """Memory and progress until the time is over."""
    begun = time.monotonic()
    while (spent := time.monotonic() - begun) < seconds:
        stop.wait(min(_LOOK_S, seconds - spent))
        if spent >= _WARM_S:
            watch.memory.append((_resident_mib(pid), sum(map(_resident_mib, child_processes(pid)))))
        if int(spent) % 10 < _LOOK_S:
            gap = max(watch.gaps, default=0.0)
            print(
                f"{spent:.0f} of {seconds:.0f} s: {len(watch.seconds)} answers, longest gap {gap:.2f} s",
                file=sys.stderr,
            )
    stop.set()


def _resident_mib(pid: int) -> float:
    try:
        for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmRSS:"):
                return int(line.split()[1]) / 1024
    except OSError:
        pass
    return 0.0


def _result(
    watch: Watch, counts: dict[str, Counter[str]], seconds: float, seed: int, code: int, log: str
) -> dict[str, Any]:
    third = max(len(watch.memory) // 3, 1)
    first, last = (
        np.median([m[0] for m in part]) if part else 0.0 for part in (watch.memory[:third], watch.memory[-third:])
    )
    tracebacks = sum('"traceback"' in line for line in log.splitlines())
    longest = max(watch.gaps, default=seconds)
    problems = [
        sentence
        for wrong, sentence in (
            (watch.wrong, f"{watch.wrong} answers were wrong"),
            (watch.lost, f"{sum(watch.lost.values())} requests were lost"),
            (longest > LATEST_S, f"the good client went {longest:.2f} s without an answer"),
            (last > _GROWTH * first + 10, f"the server grew from {first:.0f} to {last:.0f} MiB"),
            (any(count["wrong"] for count in counts.values()), "an attack got an answer that it should not get"),
            (tracebacks, f"{tracebacks} tracebacks in the log"),
            (code, f"the server ended with {code}"),
        )
        if wrong
    ]
    p50, p99 = (round(1e3 * float(v), 1) for v in np.percentile(watch.seconds or [np.nan], (50, 99)))
    return {
        "stage": "soak", "seconds": seconds, "seed": seed, "answers": len(watch.seconds), "wrong": watch.wrong,
        "late_or_busy": watch.late, "lost": dict(watch.lost), "p50_ms": p50, "p99_ms": p99,
        "longest_gap_s": round(longest, 2), "health_max_s": round(max(watch.health, default=-1), 3),
        "health_asked": len(watch.health), "server_mib_first_and_last_third": [round(first), round(last)],
        "workers_mib_most": round(max((m[1] for m in watch.memory), default=0)),
        "attacks": {name: dict(count) for name, count in counts.items()}, "log_lines": log.count("\n"),
        "problems": problems,
    }  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
