"""A transport that ends in order: what the client still sends is dropped unread, for so long and no longer.

A socket that is closed while bytes arrive resets the connection, and the client loses the answer that says why.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

LINGER_S = 10.0
_MOST_DROPPED_BYTES = 1024**3


class LingeringTransport(asyncio.Transport):
    """Stands before a connection's transport.

    Args:
        inner: the event loop's.
        unread: whether the client may still be sending what nobody reads; asked when it is closed.
    """

    def __init__(self, inner: asyncio.Transport, unread: Callable[[], bool]) -> None:
        super().__init__()
        self._inner, self._unread = inner, unread
        self._dropped_bytes = 0
        self._closing = False
        self._end: asyncio.TimerHandle | None = None

    def close(self) -> None:
        """Send what was written, then end; within ten seconds, whatever the client does."""
        if self._closing:
            return
        self._closing = True
        self._end = asyncio.get_running_loop().call_later(LINGER_S, self._inner.abort)
        if not self._unread():
            self._inner.close()
            return
        self._inner.resume_reading()
        if self._inner.can_write_eof() and not self._inner.get_write_buffer_size():
            try:
                self._inner.write_eof()
            except OSError:  # the client has left already
                self._inner.abort()

    def hurry(self) -> None:
        """End now, where the answer was sent: the server ends."""
        if self._closing and not self._inner.get_write_buffer_size():
            self._inner.abort()

    def drop(self, size: int) -> None:
        """Bytes came that nobody reads."""
        self._dropped_bytes += size
        if self._dropped_bytes > _MOST_DROPPED_BYTES:
            self._inner.abort()

    def lost(self) -> None:
        """The connection is gone."""
        if self._end is not None:
            self._end.cancel()

    def is_closing(self) -> bool:
        """Whether nothing more may be written."""
        return self._closing or self._inner.is_closing()

    def abort(self) -> None:
        """End at once."""
        self._inner.abort()

    def write(self, data: Any) -> None:
        """Send bytes."""
        self._inner.write(data)

    def pause_reading(self) -> None:
        """Take no more bytes for now."""
        self._inner.pause_reading()

    def resume_reading(self) -> None:
        """Take bytes again."""
        self._inner.resume_reading()

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """What the event loop knows about the connection."""
        return self._inner.get_extra_info(name, default)
