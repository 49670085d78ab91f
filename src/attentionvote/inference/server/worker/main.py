"""The worker process: takes a bundle, then one job after the other, and has nothing that others must not read.

``python -m attentionvote.inference.server.worker.main CHANNEL LIFELINE``, with the handles of both. It ends when the
server does: at once by the lifeline, whatever it is doing.
"""

from __future__ import annotations

import faulthandler
import fcntl
import os
import resource
import signal
import socket
import sys
import threading
import traceback
from itertools import accumulate, pairwise
from pathlib import Path

from attentionvote.contract import ModelCard
from attentionvote.inference.bundles.bundle import Bundle
from attentionvote.inference.cell import Cell, parse_cell
from attentionvote.inference.errors import BundleError
from attentionvote.inference.estimator import PoseEstimator
from attentionvote.inference.golden import self_test
from attentionvote.inference.server.priority import be_polite
from attentionvote.inference.server.worker.channel import Channel, ChannelClosed, Message
from attentionvote.inference.server.worker.jobs import Jobs

_MOST_ANSWER_BYTES = 128 * 1024 * 1024
_OUT_OF_MEMORY = 3


def main(channel_handle: int, lifeline: int) -> int:
    """Work until the server ends.

    Returns:
        The exit code.
    """
    _end_with_the_server(lifeline)
    faulthandler.enable()
    # All reach every process of a terminal or a service; the server ends its workers itself.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (_MOST_ANSWER_BYTES, _MOST_ANSWER_BYTES))
    channel = Channel(socket.socket(fileno=channel_handle))
    try:
        message = channel.receive()
        jobs, problem = _loaded(message)
        channel.send({"problem": problem})
        if jobs is None:
            return 1
        job_bytes = int(message.head["job_memory_bytes"])
        del message
        loaded = _data_bytes()
        # Of what the process shares with nobody: a body in shared memory does not count.
        resource.setrlimit(resource.RLIMIT_DATA, (loaded + job_bytes, loaded + job_bytes))
        while jobs.do_next(channel, lambda: _data_bytes() < loaded + job_bytes // 4):
            pass
    except ChannelClosed:
        return 0
    return _OUT_OF_MEMORY


def _end_with_the_server(lifeline: int) -> None:
    """Let the kernel end this process when the server's end of a pipe is closed, whatever holds the interpreter."""
    fcntl.fcntl(lifeline, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(lifeline, fcntl.F_SETFL, fcntl.fcntl(lifeline, fcntl.F_GETFL) | os.O_ASYNC)  # SIGIO, which ends it


def _data_bytes() -> int:
    """Memory of this process that it shares with nobody, reserved or used."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    (data,) = (int(line.split()[1]) * 1024 for line in status.splitlines() if line.startswith("VmData:"))
    return data


def _loaded(message: Message) -> tuple[Jobs | None, str | None]:
    """The bundle of the first message ready for jobs, or why it is not."""
    result: list[tuple[Jobs | None, str | None]] = []

    def load() -> None:
        if message.head["polite"]:
            be_polite()
        try:
            result.append(_load(message))
        except Exception as error:  # whatever a bundle does here is its refusal
            traceback.print_exc()
            result.append((None, f"it cannot be loaded: {type(error).__name__}: {error}"))

    # A thread of its own: its politeness cannot be taken back.
    thread = threading.Thread(target=load)
    thread.start()
    thread.join()
    return result[0]


def _load(message: Message) -> tuple[Jobs | None, str | None]:
    head = message.head
    ends = accumulate(head["sizes"], initial=0)
    card_text, cell_text, model, *golden = (bytes(message.content[a:b]) for a, b in pairwise(ends))
    card = ModelCard.from_json(card_text.decode())
    bundle = Bundle(Path(), card, head["digest"], model, dict(zip(head["golden"], golden, strict=True)))
    cell = parse_cell(cell_text) if cell_text else Cell()
    try:
        limits = {"threads": head["threads"], "most_points": head["most_points"]}
        estimator = PoseEstimator(bundle, crop=cell.crop, camera=cell.camera, **limits)
    except BundleError as error:
        return None, str(error)
    if not head["self_test"]:  # another worker has passed it; libraries reserve their memory at the first estimate
        estimator.estimate_parts_only(bundle.golden()[0].points)
    elif problems := self_test(estimator, bundle):
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        return None, f"the self-test failed: {problems[0]}{more}: export the bundle again"
    return Jobs(estimator, cell), None


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2])))
