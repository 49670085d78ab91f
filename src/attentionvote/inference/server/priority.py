"""Threads that give way: loading and testing a bundle costs as much processor as several requests."""

from __future__ import annotations

import os
import threading
from contextlib import suppress

_NICE = 5


def be_polite() -> None:
    """Let this thread give way to requests."""
    thread = threading.get_native_id()  # Linux schedules threads like processes
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, thread, min(os.getpriority(os.PRIO_PROCESS, thread) + _NICE, 19))
