"""References: what they say, and what is offered for those that say nothing."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.inference.errors import InputError
from attentionvote.inference.fetching.reference import Reference, is_reference, parse_reference


def test_an_alias_is_followed_and_a_version_is_pinned() -> None:
    assert parse_reference("models:/attentionvote-gear@champion") == Reference("attentionvote-gear", "champion", None)
    assert parse_reference("models:/attentionvote-gear/12") == Reference("attentionvote-gear", None, "12")
    for text in ("models:/attentionvote-gear@champion", "models:/attentionvote-gear/12"):
        assert str(parse_reference(text)) == text


@pytest.mark.parametrize(
    ("text", "nearest"),
    [
        ("models:/attentionvote-gear", "models:/attentionvote-gear@champion"),
        ("models:/attentionvote-gear/", "models:/attentionvote-gear@champion"),
        ("models:/attentionvote-gear/latest", "models:/attentionvote-gear@champion"),
        ("models:/attentionvote-gear/Production", "models:/attentionvote-gear@champion"),
        ("models:/attentionvote-gear@latest", "models:/attentionvote-gear@champion"),
        ("models:/attentionvote-gear@v3", "models:/attentionvote-gear/3"),
        ("models:/attentionvote-gear/v3", "models:/attentionvote-gear/3"),
        ("models:/attentionvote-gear/03", "models:/attentionvote-gear@champion"),
        ("models://attentionvote-gear@champion", "models:/attentionvote-gear@champion"),
        ("models:attentionvote-gear@champion", "models:/attentionvote-gear@champion"),
        ("model:/attentionvote-gear/3", "models:/attentionvote-gear/3"),
        ("runs:/0123abcd/model", "models:/0123abcd@champion"),
    ],
)
def test_what_is_none_is_refused_with_the_nearest(text: str, nearest: str) -> None:
    assert is_reference(text)
    sentence = f"must be models:/NAME@ALIAS or models:/NAME/VERSION, got {text!r}, did you mean {nearest}?"
    with pytest.raises(InputError, match=re.escape(sentence)):
        parse_reference(text)


@given(st.text(max_size=40) | st.from_regex(r"[a-z]{1,3}[@/][a-z0-9]{1,3}", fullmatch=True))
def test_whatever_is_taken_is_written_the_same_way(rest: str) -> None:
    try:
        taken = parse_reference("models:/" + rest)
    except InputError:
        return
    assert str(taken) == "models:/" + rest
    assert (taken.alias is None) != (taken.version is None)


def test_paths_are_no_references(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for text in ("bundles/latest", "/srv/bundles", "./models:/x", "latest", "C", ""):
        assert not is_reference(text), text
    monkeypatch.chdir(tmp_path)
    (tmp_path / "models:" / "gear").mkdir(parents=True)
    assert not is_reference("models:/gear")
