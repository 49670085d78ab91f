"""The load test of the server: clients, what they must get, and what they got."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.inference import BundleError, Estimate, PoseEstimator, load_bundle, self_test
from attentionvote.inference.client.pose_client import Answer, PoseClient, PoseClientError

PATIENCE_S = 60.0


# The server computes the same numbers as this process; a micrometre is room for nothing else.
TOLERANCE = 1e-6


class Expected(NamedTuple):
    """A golden cloud and what must be answered: poses ``(n, 4, 4)`` and confidences ``(n,)``."""

    points: NDArray[np.float32]
    camera_from_part: NDArray[np.float64]
    confidence: NDArray[np.float32]

    def fits(self, answer: Answer) -> bool:
        """Whether an answer is this one."""
        return (
            answer.camera_from_part.shape == self.camera_from_part.shape
            and np.allclose(answer.camera_from_part, self.camera_from_part, rtol=0, atol=TOLERANCE)
            and np.allclose(answer.confidence, self.confidence, rtol=0, atol=TOLERANCE)
        )


@dataclass
class Tally:
    """What one client saw: seconds of every right answer, and sentences about the others."""

    seconds: list[float] = field(default_factory=list)
    wrong: int = 0
    lost: list[str] = field(default_factory=list)


def expectations(bundle_folder: Path, key: Path) -> list[Expected]:
    """The golden clouds with the answers of an estimator that has passed its self-test.

    Raises:
        BundleError: when the bundle cannot be trusted or does not reproduce its poses here.
    """
    bundle = load_bundle(bundle_folder, key)
    with PoseEstimator(bundle) as estimator:
        problems = self_test(estimator, bundle)
        if problems:
            raise BundleError(f"{bundle_folder}: the self-test failed: {problems[0]}")
        expected = []
        for cloud in bundle.golden():
            answer = estimator.estimate(cloud.points)
            detections = answer.detections if isinstance(answer, Estimate) else ()
            poses = np.array([d.camera_from_part for d in detections], np.float64).reshape(-1, 4, 4)
            expected.append(Expected(cloud.points, poses, np.array([d.confidence for d in detections], np.float32)))
    return expected


def bench(
    bundle: Path, key: Path, expected: list[Expected], seconds: float, clients: int, queue: int
) -> dict[str, Any]:
    """Load a server and say how it did.

    Raises:
        OSError: when the server cannot be started.
    """
    tallies = [Tally() for _ in range(clients)]
    with server(bundle, key, queue) as url:
        with PoseClient(url, timeout_s=PATIENCE_S) as first:
            first.estimate(expected[0].points)  # waits until the server is ready
        begun = time.monotonic()
        threads = [
            threading.Thread(target=_ask, args=(url, expected, i, tally, begun + seconds))
            for i, tally in enumerate(tallies)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        elapsed = time.monotonic() - begun
        metrics = _metrics(url)
    times = np.array([value for tally in tallies for value in tally.seconds])
    lost = [sentence for tally in tallies for sentence in tally.lost]
    wrong = sum(tally.wrong for tally in tallies)
    for sentence in lost[:5]:
        print(f"lost: {sentence}", file=sys.stderr)
    # What the server counted must be what the clients saw, and the first request before them.
    lost += [] if metrics["answered"] == len(times) + wrong + 1 else ["server and clients count differently"]
    p50, p99 = (float(1e3 * value) for value in np.percentile(times, (50, 99))) if len(times) else (None, None)
    return {
        "stage": "bench-serve",
        "bundle": str(bundle),
        "clients": clients,
        "queue": queue,
        "seconds": round(elapsed, 2),
        "answered": len(times),
        "wrong": wrong,
        "lost": len(lost),
        "overloaded": metrics["overloaded"],
        "per_second": round(len(times) / elapsed, 2),
        "p50_ms": p50,
        "p99_ms": p99,
        "estimate_ms": round(1e3 * metrics["estimate_s"], 2),
        "peak_memory_mb": round(metrics["memory"] / 1e6, 1),
    }


@contextmanager
def server(bundle: Path, key: Path, queue: int) -> Iterator[str]:
    """The address of a server in a process of its own, as a cell starts it.

    Raises:
        OSError: with its last line, when it does not start or does not end in order.
    """
    with tempfile.TemporaryDirectory(prefix="bench-serve-") as folder:
        log_file = Path(folder) / "server.log"
        words = [str(bundle), "--key", str(key), "--port", "0", "--state", f"{folder}/state", "--queue", str(queue)]
        with log_file.open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "attentionvote.inference.command_line", "serve", *words],
                stdout=subprocess.PIPE,
                stderr=log,
                start_new_session=True,  # Ctrl-C ends the bench, which ends the server
            )
        assert process.stdout is not None
        try:
            line = process.stdout.readline()
            if not line:
                raise OSError(f"the server did not start: {_last_line(log_file)}")
            yield str(json.loads(line)["url"])
        finally:
            process.terminate()
            try:
                code = process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                process.kill()
                code = process.wait()
            process.stdout.close()
        if code != 0:
            raise OSError(f"the server must end with 0, got {code}: {_last_line(log_file)}")


def _ask(url: str, expected: list[Expected], offset: int, tally: Tally, until: float) -> None:
    """One client: cloud after cloud until the time is over."""
    turn = offset
    with PoseClient(url, timeout_s=PATIENCE_S) as client:
        while time.monotonic() < until:
            asked = expected[turn % len(expected)]
            turn += 1
            begun = time.monotonic()
            try:
                answer = client.estimate(asked.points)
            except PoseClientError as error:
                tally.lost.append(f"{type(error).__name__}: {error}")
                time.sleep(0.1)
                continue
            if asked.fits(answer):
                tally.seconds.append(time.monotonic() - begun)
            else:
                tally.wrong += 1


def _metrics(url: str) -> dict[str, float]:
    """What the server counted."""
    import urllib.request

    from prometheus_client.parser import text_string_to_metric_families

    with urllib.request.urlopen(f"{url}/metrics", timeout=PATIENCE_S) as response:
        families = text_string_to_metric_families(response.read().decode())
    values = {(s.name.removeprefix("attentionvote_"), *s.labels.values()): s.value for f in families for s in f.samples}
    count = values["request_seconds_count", "estimate"]
    return {
        "answered": int(values["requests_total", "ok"] + values["requests_total", "abstained"]),
        "overloaded": int(values["requests_total", "overloaded"]),
        "estimate_s": values["request_seconds_sum", "estimate"] / max(count, 1),
        "memory": values["peak_memory_bytes",] + values["worker_memory_bytes",],
    }


def _last_line(log_file: Path) -> str:
    lines = log_file.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else "it said nothing"


def table(result: dict[str, Any]) -> str:
    """The result for a terminal."""
    rows = [
        ("clients, queue", f"{result['clients']}, {result['queue']}"),
        ("answered", f"{result['answered']} in {result['seconds']} s, {result['per_second']} a second"),
        ("wrong, lost", f"{result['wrong']}, {result['lost']}"),
        ("503, asked again", f"{result['overloaded']}"),
        ("p50, p99", "-" if result["p50_ms"] is None else f"{result['p50_ms']:.1f} ms, {result['p99_ms']:.1f} ms"),
        ("estimate", f"{result['estimate_ms']} ms on average, without queue and transfer"),
        ("memory", f"{result['peak_memory_mb']} MB at most"),
    ]
    return "\n".join(f"{name:18} {value}" for name, value in rows)
