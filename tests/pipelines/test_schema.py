"""The ranges: every setting of every verb has one, its default lies in it, and beyond it there is a sentence."""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest
from omegaconf import OmegaConf

from attentionvote.command.conf_folder import CONF, choices, primary_groups
from attentionvote.command.configuration import compose, leaves
from attentionvote.command.schema import RANGES, Range, range_of, violation

VERBS = sorted(p.stem for p in CONF.glob("*.yaml"))


@cache
def settings(verb: str) -> dict[str, Any]:
    """Every setting of a verb with its default, over every choice of every group (one object stands for all)."""
    named = primary_groups(verb)
    needed = {group: word for group, word in {"object": "connecting_rod", "table": "table_6"}.items() if group in named}
    more = ["name=bracket", "mesh=bracket.stl"] if verb == "part" else []
    variants = [{group: choice} for group in sorted(set(named) - {"object"}) for choice in choices(group)]
    found: dict[str, Any] = {}
    for chosen in [{}, *variants]:
        words = [f"{group}={choice}" for group, choice in {**needed, **chosen}.items()]
        for key, value in leaves(OmegaConf.to_container(compose(verb, [*words, *more]))):
            found[key] = value if found.get(key) is None else found[key]
    return found


@pytest.mark.parametrize("verb", VERBS)
def test_every_number_has_a_range_and_beyond_it_a_sentence(verb: str) -> None:
    numbers = {k: v for k, v in settings(verb).items() if isinstance(v, (int, float)) and not isinstance(v, bool)}
    for key, value in numbers.items():
        assert violation(key, value) == "", key
        for beyond in (float("nan"), float("inf"), -float("inf")):
            assert violation(key, beyond).startswith(f"{key} must be "), key
        if range_of(key).pattern != key:  # signed settings have no bounds
            assert violation(key, -1e-6).endswith("got -1e-06"), key


@pytest.mark.parametrize("verb", VERBS)
def test_every_setting_that_may_be_null_says_its_type_in_the_table(verb: str) -> None:
    untyped = [k for k, v in settings(verb).items() if v is None and range_of(k).kind is None]
    assert not untyped


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("data.batch_size", -1, "data.batch_size must be at least 1; got -1"),
        ("workers", 0, "workers must be a whole number at least 1 and at most 1024; got 0"),
        ("workers", "abc", "workers must be a whole number at least 1 and at most 1024; got 'abc'"),
        ("workers", 1.5, "workers must be a whole number at least 1 and at most 1024; got 1.5"),
        ("trainer.lr", 0.0, "trainer.lr must be greater than 0 and at most 10; got 0.0"),
        ("sensor", "phoxy", "sensor must be one of none, gaussian, phoxi; got 'phoxy', did you mean 'phoxi'?"),
        ("simulation.drop_counts", [6, 0], "simulation.drop_counts must be at least 1 and at most 1000; got 0"),
        ("whatever.length", -0.1, "whatever.length must be at least 0; got -0.1"),
    ],
)
def test_a_value_out_of_range_gets_one_sentence(key: str, value: object, words: str) -> None:
    assert violation(key, value) == words


@pytest.mark.parametrize(("key", "value"), [("workers", None), ("object.symmetry.axis", [0, -1, 0]), ("flag", True)])
def test_null_signed_settings_and_flags_pass(key: str, value: object) -> None:
    assert violation(key, value) == ""


def test_no_pattern_hides_behind_an_earlier_one() -> None:
    for entry in RANGES:
        probe = entry.pattern.replace("[wh]*", "width").replace("[xy]", "x").replace("*", "probe")
        assert range_of(probe) is entry, f"{entry.pattern} is hidden by {range_of(probe).pattern}"


def test_a_range_says_what_it_allows() -> None:
    assert str(Range("x", low=1, high=3)) == "at least 1 and at most 3"
    assert str(Range("x")) == "a finite number"
    assert str(Range("x", kind=str)) == "a text"


@pytest.mark.parametrize("key", ["tracking.store", "storage"])
def test_an_address_with_a_password_is_refused_without_saying_it(key: str) -> None:
    said = violation(key, "postgresql://me:swordfish@db/mlflow")
    assert said.startswith(f"{key} must not hold a password, because settings are kept with every run")
    assert "'postgresql://me:***@db/mlflow'" in said
    assert "swordfish" not in said
    assert violation(key, "postgresql://me@db:5432/mlflow") == ""
