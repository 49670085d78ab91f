"""Messages between two ends: whole, bounded, and refused when they are none."""

from __future__ import annotations

import os
import socket

import pytest

from attentionvote.inference.server.worker.channel import Channel, ChannelClosed, SharedContent


def test_a_message_arrives_whole_with_its_content() -> None:
    one, other = Channel.pair()
    big = os.urandom(3_000_000)
    with SharedContent.of(b"", big[:7], big[7:]) as content:
        assert content.size == len(big)
        one.send({"kind": "file", "n": 1.5}, content)
    one.send({"next": True})
    head, body = other.receive(5)
    assert head == {"kind": "file", "n": 1.5}
    assert bytes(body) == big  # the sender has closed its own handle
    assert other.receive(5) == ({"next": True}, memoryview(b""))
    for channel in (one, other):
        channel.close()


def test_silence_and_an_end_are_told_apart() -> None:
    one, other = Channel.pair()
    with pytest.raises(TimeoutError):
        other.receive(0.01)
    one.close()
    with pytest.raises(ChannelClosed, match="the other side has ended"):
        other.receive(5)
    with pytest.raises(ChannelClosed, match="the other side has ended"):
        other.send({})
    other.close()


@pytest.mark.parametrize(
    "packed", [b"{", b"[]", b"3", b"{}", b'{"content_bytes": 7}', b'{"content_bytes": "x"}', b"\xff"]
)
def test_what_is_no_message_ends_the_channel(packed: bytes) -> None:
    raw, inner = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    other = Channel(inner)
    raw.send(packed)
    with pytest.raises(ChannelClosed, match="the other side sent no message"):
        other.receive(5)
    raw.close()
    other.close()


def test_a_content_shorter_than_it_says_is_never_mapped() -> None:
    one, other = Channel.pair()
    with SharedContent.of(b"abc") as content:
        content.size = 5_000_000  # reading beyond the end of a mapped file would end the process
        one.send({}, content)
    with pytest.raises(ChannelClosed, match="shorter than its message says"):
        other.receive(5)
    one.close()
    other.close()


def test_a_head_beyond_its_size_is_refused_before_it_is_sent() -> None:
    one, other = Channel.pair()
    with pytest.raises(ValueError, match="must have at most 131072 bytes, got"):
        one.send({"text": "x" * 140_000})
    one.close()
    other.close()


def test_no_handle_is_left_open() -> None:
    before = len(os.listdir("/proc/self/fd"))
    one, other = Channel.pair()
    for _ in range(20):
        with SharedContent.of(b"abc") as content:
            one.send({}, content)
        assert bytes(other.receive(5).content) == b"abc"
    one.close()
    other.close()
    assert len(os.listdir("/proc/self/fd")) == before
