"""Sentences about names."""

from __future__ import annotations

import time

from attentionvote.inference.errors import nearest


def test_a_close_name_is_offered() -> None:
    assert nearest("camera_from_prt", ["camera_from_part", "heat"]) == ", did you mean 'camera_from_part'?"
    assert nearest("x", ["camera_from_part", "heat"]) == ""


def test_a_name_of_any_length_is_compared_at_once() -> None:
    begun = time.process_time()
    assert nearest("abcdefgh" * 1_000_000, ["camera_from_part", "confidence", "heat"]) == ""
    assert time.process_time() - begun < 0.2
