"""Messages between server and worker: a short JSON object, and contents of any size in shared memory beside it.

One message is one datagram of a connected pair of sockets, so a message is there whole or not at all. Contents travel
as the handle of an anonymous file: neither side copies a scan of 60 MB, and no pickle is read on either.
"""

from __future__ import annotations

import json
import mmap
import os
import socket
from collections.abc import Iterable
from typing import Any, NamedTuple

_MOST_BYTES = 128 * 1024
Buffer = bytes | bytearray | memoryview
# A job that only shows whether a worker listens.
PING = {"kind": "ping"}


class ChannelClosed(ConnectionError):
    """The other side has ended, or sent something that is no message."""


class SharedContent:
    """Bytes in shared memory, written piece by piece. Whoever makes it closes it."""

    def __init__(self) -> None:
        self.size = 0
        self._handle = os.memfd_create("attentionvote", os.MFD_CLOEXEC)

    @classmethod
    def of(cls, *pieces: Buffer) -> SharedContent:
        """Content that consists of these pieces."""
        content = cls()
        for piece in pieces:
            content.write(piece)
        return content

    def write(self, piece: Buffer) -> None:
        """Append bytes.

        Raises:
            OSError: when there is no memory left.
        """
        view = memoryview(piece)
        while len(view):
            done = os.write(self._handle, view)
            view = view[done:]
            self.size += done

    def content(self) -> bytes:
        """All of it."""
        return os.pread(self._handle, self.size, 0)

    def fileno(self) -> int:
        """The handle, for the channel."""
        return self._handle

    def close(self) -> None:
        """Let it go; a receiver keeps what it has mapped."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1

    def __enter__(self) -> SharedContent:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Message(NamedTuple):
    """What was received: the JSON object, and the content beside it (empty when there was none)."""

    head: dict[str, Any]
    content: memoryview


class Channel:
    """One end of a connected pair.

    Args:
        connection: a ``SOCK_SEQPACKET`` socket of the family ``AF_UNIX``.
    """

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection

    @classmethod
    def pair(cls) -> tuple[Channel, Channel]:
        """Both ends of a new one."""
        near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        return cls(near), cls(far)

    def fileno(self) -> int:
        """The socket's handle."""
        return self._connection.fileno()

    def send(self, head: dict[str, Any], content: SharedContent | None = None) -> None:
        """Send a message.

        Raises:
            ChannelClosed: when nobody reads any more.
            ValueError: when the object is too large for a message.
        """
        packed = json.dumps(head | {"content_bytes": 0 if content is None else content.size}).encode()
        if len(packed) > _MOST_BYTES:
            raise ValueError(f"a message must have at most {_MOST_BYTES} bytes, got {len(packed)}")
        handles: Iterable[int] = () if content is None else (content.fileno(),)
        try:
            socket.send_fds(self._connection, [packed], list(handles))
        except OSError as error:
            raise ChannelClosed(f"the other side has ended ({error.strerror})") from error

    def receive(self, timeout_s: float | None = None) -> Message:
        """Wait for a message.

        Raises:
            TimeoutError: when none comes in time.
            ChannelClosed: when the other side has ended, or sent something else.
        """
        self._connection.settimeout(None if timeout_s is None else max(timeout_s, 1e-3))
        try:
            packed, handles, flags, _ = socket.recv_fds(self._connection, _MOST_BYTES, 1)
        except TimeoutError:
            raise
        except OSError as error:
            raise ChannelClosed(f"the other side has ended ({error.strerror})") from error
        try:
            if not packed or flags & (socket.MSG_TRUNC | socket.MSG_CTRUNC):
                raise ChannelClosed("the other side has ended")
            head = json.loads(packed)
            size = head.pop("content_bytes")
            if not size:
                return Message(head, memoryview(b""))
            # A mapping beyond the end of its file ends the process that reads it.
            if os.fstat(handles[0]).st_size < size:
                raise ChannelClosed("the content is shorter than its message says")
            return Message(head, memoryview(mmap.mmap(handles[0], size, prot=mmap.PROT_READ)))
        except (ValueError, TypeError, KeyError, IndexError, AttributeError) as error:
            raise ChannelClosed(f"the other side sent no message ({error})") from error
        finally:
            for handle in handles:
                os.close(handle)

    def close(self) -> None:
        """Close this end."""
        self._connection.close()
