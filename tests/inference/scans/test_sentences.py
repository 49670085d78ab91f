"""No file puts a second line into a sentence."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from attentionvote.inference.scans.sentences import single_line


def test_line_ends_and_control_characters_are_replaced() -> None:
    assert single_line("got a\nb\r\x1b[2Jc\u2028d\0, not é") == "got a?b??[2Jc?d?, not é"


@given(st.text(max_size=700))
def test_every_text_becomes_one_line_of_bounded_length(text: str) -> None:
    line = single_line(text)
    assert line.isprintable()
    assert len(line) == min(len(text), 600)
    assert single_line(line) == line


def test_long_sentences_show_that_they_were_cut() -> None:
    assert single_line("a" * 601) == "a" * 599 + "…"
