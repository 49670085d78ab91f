"""Many small chunks: refused after the first thousand, whoever sends them."""

from __future__ import annotations

import h11
import pytest

from attentionvote.inference.server.network.chunks import FREE_CHUNKS, LEAST_CHUNK_BYTES, BoundedChunks

HEAD = b"POST /poses HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"


def body_bytes(connection: BoundedChunks, chunk: bytes, count: int) -> int:
    """Bytes of the body after so many equal chunks."""
    connection.receive_data(b"%x\r\n%b\r\n" % (len(chunk), chunk) * count)
    size = 0
    while (event := connection.next_event()) is not h11.NEED_DATA:
        size += len(event.data)
    return size


def begun() -> BoundedChunks:
    connection = BoundedChunks()
    connection.receive_data(HEAD)
    assert isinstance(connection.next_event(), h11.Request)
    return connection


def test_a_thousand_small_chunks_are_a_client_s_own_affair() -> None:
    connection = begun()
    assert body_bytes(connection, b"x", FREE_CHUNKS) == FREE_CHUNKS
    assert connection.problem is None


def test_more_of_them_are_one_sentence() -> None:
    connection = begun()
    body_bytes(connection, b"x", FREE_CHUNKS)
    with pytest.raises(h11.RemoteProtocolError):
        body_bytes(connection, b"x", 1)
    assert connection.problem == (
        "a body of more than 1024 chunks must have at least 256 bytes a chunk, got 1: send larger chunks, or the body "
        "with its Content-Length"
    )


def test_any_number_of_large_enough_chunks_is_read() -> None:
    assert body_bytes(begun(), b"x" * LEAST_CHUNK_BYTES, 5000) == 5000 * LEAST_CHUNK_BYTES


def test_a_body_with_its_length_may_come_in_any_pieces() -> None:
    connection = BoundedChunks()
    connection.receive_data(b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 3000\r\n\r\n")
    connection.next_event()
    for _ in range(3000):
        connection.receive_data(b"x")
        assert len(connection.next_event().data) == 1
    assert isinstance(connection.next_event(), h11.EndOfMessage)
