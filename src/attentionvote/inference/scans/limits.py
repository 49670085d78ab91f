"""Limits of reading one input file, whatever its kind: bytes it unpacks to, entries, and processor seconds."""

from __future__ import annotations

import time

MIB = 1024 * 1024
MOST_INPUT_BYTES = 512 * MIB
MOST_POINTS = 4_000_000
MOST_PIXELS = 8_000_000
# An organised frame of 2448 x 2048 points as doubles in an archive, and the same as float32, which is what comes out.
MOST_UNPACKED_BYTES = 256 * MIB
MOST_ARRAYS = 32
MOST_CHUNKS = 65_536
MOST_SECONDS = 0.5
# Rows or bytes between two looks at the clock: some milliseconds of work.
BLOCK_ROWS, BLOCK_BYTES = 65_536, MIB


class Budget:
    """What may still be spent on one input. Readers take bytes before they reserve them, and check the clock often.

    Args:
        most_bytes: of everything that is unpacked or converted, together.
        most_seconds: of processor time of the reading thread, from now on.
    """

    def __init__(self, most_bytes: int = MOST_UNPACKED_BYTES, most_seconds: float = MOST_SECONDS) -> None:
        self._most_bytes, self._most_seconds = most_bytes, most_seconds
        self._bytes_left = most_bytes
        # Of this thread: what the runtime's threads do meanwhile is not the input's cost, nor is waiting.
        self._end = time.thread_time() + most_seconds

    def take(self, size: int) -> None:
        """Account for ``size`` bytes that are about to be reserved.

        Raises:
            ValueError: when that is more than is left.
        """
        if size > self._bytes_left:
            raise ValueError(
                f"it must unpack to at most {self._most_bytes} bytes, got more: crop or thin it out, or send float32"
            )
        self._bytes_left -= size

    def check_time(self) -> None:
        """Look at the clock.

        Raises:
            ValueError: when the processor time is spent.
        """
        if time.thread_time() > self._end:
            raise ValueError(
                f"it must be read within {self._most_seconds:g} s of processor time, but it takes longer: "
                "send a binary PLY or a .npy file instead"
            )
