"""Clients that mean a server no good: each attacks until it is told to stop and counts what it did. Loopback only."""

from __future__ import annotations

import http.client
import io
import os
import random
import signal
import socket
import struct
import threading
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from scan_mutations import damaged_file

# What a refusal may be; anything else, 500 above all, is a fault of the server.
EXPECTED = {200, 400, 408, 413, 415, 422, 431, 503, 504}
Attack = Callable[[str, int, threading.Event, Counter[str], random.Random], None]


def damaged_files(host: str, port: int, stop: threading.Event, count: Counter[str], rng: random.Random) -> None:
    """Damaged scans, one after the other on a kept connection; ``wrong`` counts answers that no file should get."""
    connection = http.client.HTTPConnection(host, port, timeout=20)
    seed = rng.randrange(10**9)
    while not stop.is_set():
        seed += 1
        try:
            connection.request("POST", "/poses", damaged_file(seed), {"X-Deadline-Ms": "1000"})
            status = connection.getresponse()
            status.read()
            count[str(status.status)] += 1
            if status.status not in EXPECTED:
                count["wrong"] += 1
                count[f"wrong: seed {seed} status {status.status}"] += 1
        except (OSError, http.client.HTTPException):
            count["closed"] += 1
            connection.close()
        if status_is_busy(count):
            stop.wait(0.02)
    connection.close()


def status_is_busy(count: Counter[str]) -> bool:
    """Give way now and then: a flood of refusals would only measure the client."""
    return sum(count.values()) % 8 == 0


def silent_connections(host: str, port: int, stop: threading.Event, count: Counter[str], rng: random.Random) -> None:
    """Some hundred connections that never say a word; closed ones are opened again."""
    held: list[socket.socket] = []
    while not stop.is_set():
        with suppress(OSError):
            one = socket.create_connection((host, port), timeout=2)
            held.append(one)
            count["opened"] += 1
        if len(held) >= 400:
            held.pop(rng.randrange(len(held))).close()
        stop.wait(0.02)
    for one in held:
        one.close()


def drips(host: str, port: int, stop: threading.Event, count: Counter[str], rng: random.Random) -> None:
    """Request lines, headers and bodies, a byte at a time."""
    heads = (
        b"GET /v2/health/ready HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow: " + b"y" * 500,
        b"POST /poses HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 50000\r\n\r\n" + b"z" * 50_000,
        b"POST /poses HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\n" + b"1\r\nz\r\n" * 10_000,
    )
    while not stop.is_set():
        head = rng.choice(heads)
        try:
            with socket.create_connection((host, port), timeout=5) as one:
                one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                for i in range(len(head)):
                    if stop.is_set():
                        break
                    one.sendall(head[i : i + 1])
                    count["bytes"] += 1
                    stop.wait(0.002)
        except OSError:
            count["cut off"] += 1


def stalled_bodies(host: str, port: int, stop: threading.Event, count: Counter[str], rng: random.Random) -> None:
    """A dozen uploads that stop in the middle and wait for their deadlines."""
    held: list[socket.socket] = []
    head = b"POST /poses HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Deadline-Ms: 60000\r\nContent-Length: 900000\r\n\r\n"
    while not stop.wait(0.2):
        with suppress(OSError):
            one = socket.create_connection((host, port), timeout=2)
            one.sendall(head + bytes(rng.randrange(1, 500_000)))
            held.append(one)
            count["begun"] += 1
        if len(held) > 12:
            held.pop(0).close()
    for one in held:
        one.close()


def bombs(host: str, port: int, stop: threading.Event, count: Counter[str], rng: random.Random) -> None:
    """Small bodies that want to become large, slow or endless."""
    bodies = list(bomb_bodies().values())
    while not stop.is_set():
        body = rng.choice(bodies)
        try:
            connection = http.client.HTTPConnection(host, port, timeout=20)
            connection.request("POST", "/poses", body, {"X-Deadline-Ms": str(rng.choice([200, 2000, 60_000]))})
            status = connection.getresponse().status
            count[str(status)] += 1
            count["wrong"] += status not in EXPECTED
            connection.close()
        except (OSError, http.client.HTTPException):
            count["closed"] += 1
        stop.wait(0.3)


def bomb_bodies() -> dict[str, bytes]:
    """The bodies of ``bombs`` by name."""
    cloud = np.random.default_rng(0).normal(scale=0.1, size=(40_000, 3)).astype(np.float32) + np.float32([0, 0, 0.8])
    largest = np.finfo(np.float32).max
    strays = cloud.copy()
    strays[::400] = np.float32([largest, -largest, largest])
    return {
        "strays": _npy(strays),
        "half strays": _npy(np.where(np.arange(40_000)[:, None] % 2, cloud, np.float32(1e30))),
        "one place": _npy(np.repeat(cloud[:1], 40_000, axis=0)),
        "subnormal": _npy(cloud * np.float32(1e-44)),
        "four million": _npy(np.repeat(cloud, 100, axis=0)),
        "lzma": _packed(zipfile.ZIP_LZMA, 40_000_000),
        "bzip2": _packed(zipfile.ZIP_BZIP2, 40_000_000),
        "deflated": _packed(zipfile.ZIP_DEFLATED, 400_000_000),
        "two headers": _png_with_two_headers(),
        "literals": _pcd_of_literals(500_000),
    }


def _npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def _packed(packing: int, size: int) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", packing) as archive, archive.open("points.npy", "w", force_zip64=True) as member:
        for _ in range(size // 1_000_000):
            member.write(bytes(1_000_000))
    return stream.getvalue()


def _png_with_two_headers() -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    small = chunk(b"IHDR", struct.pack(">IIBBBBB", 4, 4, 16, 0, 0, 0, 0))
    large = chunk(b"IHDR", struct.pack(">IIBBBBB", 20_000, 20_000, 16, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + small + large + chunk(b"IDAT", zlib.compress(bytes(1_000_000))) + chunk(b"IEND", b"")


def _pcd_of_literals(size: int) -> bytes:
    points = size // 12
    head = (
        f"VERSION .7\nFIELDS x y z rest\nSIZE 4 4 4 1\nTYPE F F F U\nCOUNT 1 1 1 13\nWIDTH {points}\nHEIGHT 1\n"
        f"POINTS {points}\nDATA binary_compressed\n"
    )
    packed = b"\x00\x3f" * (points * 12)  # every coordinate is .747
    return head.encode() + struct.pack("<II", len(packed), points * 25) + packed


def stopped_workers(pid: int, stop: threading.Event, count: Counter[str], rng: random.Random) -> None:
    """Stop or kill one of the server's workers now and then: whatever an input could do to it."""
    while not stop.wait(rng.uniform(3, 6)):
        workers = child_processes(pid)
        if workers:
            number = rng.choice([signal.SIGSTOP, signal.SIGSTOP, signal.SIGSEGV, signal.SIGKILL])
            with suppress(ProcessLookupError):
                os.kill(rng.choice(workers), number)
                count[number.name] += 1


def child_processes(pid: int) -> list[int]:
    """The children of a process."""
    children = []
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(OSError):
            children += [int(word) for word in path.read_text(encoding="ascii").split()]
    return children


def swaps(link: Path, folders: Sequence[Path], stop: threading.Event, count: Counter[str]) -> None:
    """Move the link that is served to the next bundle every few seconds."""
    turn = 0
    while not stop.wait(7):
        turn += 1
        temporary = link.with_name("next")
        temporary.symlink_to(folders[turn % len(folders)])
        temporary.replace(link)
        count["swaps"] += 1


ATTACKS: dict[str, Attack] = {
    "damaged files": damaged_files,
    "silent connections": silent_connections,
    "drips": drips,
    "stalled bodies": stalled_bodies,
    "bombs": bombs,
}
