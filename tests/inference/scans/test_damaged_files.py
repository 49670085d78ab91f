"""Thousands of damaged files of every kind: an array or one sentence comes out, within memory and time."""

from __future__ import annotations

import tracemalloc

import pytest
from scan_mutations import FILES, complaint, damaged_file

from attentionvote.inference.errors import InputError
from attentionvote.inference.scans.cloud_files import read_cloud
from attentionvote.inference.scans.depth_files import read_depth

MIB = 1024 * 1024
COUNT = 3000


def test_the_intact_files_are_read() -> None:
    unread = []
    for content in FILES:
        try:
            read_cloud(content)
        except InputError as error:
            unread.append(str(error))
    assert len(unread) == 3  # a depth image twice, and the LZMA archive
    read_depth(FILES[-1])


@pytest.mark.usefixtures("way")
def test_damaged_files_give_an_array_or_one_sentence() -> None:
    wrong = {seed: sentence for seed in range(COUNT) if (sentence := complaint(damaged_file(seed)))}
    assert not wrong


def test_damaged_small_files_reserve_little_memory() -> None:
    for content in FILES:  # imports and caches
        complaint(content)
    peak = 0
    tracemalloc.start()
    try:
        for seed in range(COUNT, COUNT + 1000):
            content = damaged_file(seed)
            tracemalloc.reset_peak()
            before = tracemalloc.get_traced_memory()[0]
            complaint(content)
            peak = max(peak, tracemalloc.get_traced_memory()[1] - before)
    finally:
        tracemalloc.stop()
    assert peak < 4 * MIB


def test_the_damage_reaches_behind_the_headers() -> None:
    read = sum(not _refused(damaged_file(seed)) for seed in range(500))
    assert 50 < read < 450


def _refused(content: bytes) -> bool:
    try:
        read_cloud(content)
    except InputError:
        return True
    return False
