"""The settings of every verb: each has a field, each field a meaning and a range, each default lies in it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, get_args, get_origin

import pytest
from settings_of_verbs import settings_of

from attentionvote.command.conf_folder import CONF, SCRIPTS, choices, primary_groups
from attentionvote.command.configuration import compose, leaves
from attentionvote.command.errors import ConfigurationError
from attentionvote.command.help import help_text
from attentionvote.model.fusion import FUSIONS
from attentionvote.section import Target, check_value, find
from attentionvote.section import leaves as fields_below
from attentionvote.setting import Field, SettingError, without_null
from attentionvote.workflows.train.job import find_training
from attentionvote.workflows.train.settings import TrainSettings

VERBS = sorted(path.stem for path in CONF.glob("*.yaml"))
# Symmetries, arguments of Lightning's and other things that their own code checks.
UNTYPED = ("object.symmetry", "object.parts", "callbacks.", "loggers.", "table.", "sweep.space", "evaluation.frozen")


@cache
def composed(verb: str) -> dict[str, tuple[Any, Field | None]]:
    """Every setting of a verb with its default and its field, over every choice of every group (one object of all)."""
    named = primary_groups(verb)
    needed = {group: word for group, word in {"object": "connecting_rod", "table": "table_6"}.items() if group in named}
    more = ["name=bracket", "mesh=bracket.stl"] if verb == "part" else []
    variants = [{group: choice} for group in sorted(set(named) - {"object"}) for choice in choices(group)]
    settings = settings_of(verb)
    found: dict[str, tuple[Any, Field | None]] = {}
    for chosen in [{}, *variants]:
        words = [f"{group}={choice}" for group, choice in {**needed, **chosen}.items()]
        plain = compose(settings, [*words, *more]).composed
        for key, value in leaves(plain):
            if found.get(key, (None, None))[0] is None:
                found[key] = value, find(settings, key, plain)
    return found


def is_typed(key: str) -> bool:
    """Whether a key lies in a typed section."""
    return not key.startswith(UNTYPED) and key != "object._target_"


@pytest.mark.parametrize("verb", VERBS)
def test_every_key_of_conf_has_a_field_with_a_meaning(verb: str) -> None:
    bare = [
        key for key, (_, field) in composed(verb).items() if is_typed(key) and (not field or not field.setting.help)
    ]
    assert not bare


@pytest.mark.parametrize("verb", VERBS)
def test_every_field_without_a_default_is_in_conf(verb: str) -> None:
    known = composed(verb)
    for key, field in fields_below(settings_of(verb)):
        if field.default is ... and field.type is not Target:
            assert any(name == key or name.startswith(f"{key}.") for name in known), key


def numbers(type_: Any) -> set[type]:
    """The kinds of numbers that a type holds."""
    type_, _ = without_null(type_)
    if type_ in (int, float):
        return {type_}
    if get_origin(type_) in (tuple, dict, Mapping):
        return set().union(*(numbers(inner) for inner in get_args(type_) if inner not in (..., str)))
    return set()


@pytest.mark.parametrize("verb", VERBS)
def test_every_number_has_bounds_on_both_sides_and_beyond_them_a_sentence(verb: str) -> None:
    settings = settings_of(verb)
    for key, field in fields_below(settings):
        if not numbers(field.type):
            continue
        s = field.setting
        assert max(s.low, s.above) > -math.inf, key
        assert s.high < math.inf, key
        scalar = without_null(field.type)[0] in (int, float)
        for beyond in (math.nan, math.inf, -math.inf, s.high * 2 + 1, "x", True, []):
            if scalar:
                with pytest.raises(SettingError, match=f"^{key} must be "):
                    check_value(settings, key, beyond)
        if math.isfinite(s.low) and scalar:
            with pytest.raises(SettingError, match=f"^{key} must be .*; got {s.low - 1!r}"):
                check_value(settings, key, s.low - 1 if without_null(field.type)[0] is float else int(s.low) - 1)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("trainer.batch_size=-1", "trainer.batch_size must be at least 1 and at most 100000; got -1"),
        ("workers=0", "workers must be a whole number at least 1 and at most 1024; got 0"),
        ("workers=abc", "workers must be a whole number at least 1 and at most 1024; got 'abc'"),
        ("workers=1.5", "workers must be a whole number at least 1 and at most 1024; got 1.5"),
        ("trainer.learning_rate=0.0", "trainer.learning_rate must be greater than 0 and at most 10; got 0.0"),
        ("data.sensor.preset=phoxy",
         "data.sensor.preset must be one of none, gaussian, phoxi; got 'phoxy', did you mean 'phoxi'?"),
        ("simulation.drop_counts=[6,0]", "simulation.drop_counts must be at least 1 and at most 200; got 0"),
        # What only the last row of a table of ranges covered, or two ranges that disagreed.
        ("loss.settings.rows_per_scene=0", "loss.settings.rows_per_scene must be at least 1 and at most 100000; got 0"),
        ("loss.settings.assignment=0", "loss.settings.assignment must be greater than 0 and at most 10; got 0"),
        ("simulation.bin.jitter=0.7", "simulation.bin.jitter must be at least 0 and at most 0.5; got 0.7"),
        ("simulation.drop.speed=50", "simulation.drop.speed must be greater than 0 and at most 5; got 50"),
        ("simulation.drop.hull_vertices=4",
         "simulation.drop.hull_vertices must be at least 8 and at most 256; got 4"),
        ("model.fusion_kind=amk",
         f"model.fusion_kind must be one of {', '.join(FUSIONS)}; got 'amk', did you mean 'amx'?"),
        # What Hydra's grammar adds or takes away.
        ("+trainer.accumulate_grad_batch=2",
         "there is no setting 'trainer.accumulate_grad_batch', did you mean 'trainer.accumulate_grad_batches'?"),
        ("trainer.limit_val_batches=1.5",
         "trainer.limit_val_batches must be a share of at most 1.0, or a whole number of batches; got 1.5"),
        ("trainer.fast_dev_run=few",
         "trainer.fast_dev_run must be true or false or a whole number at least 0 and at most 100000; got 'few'"),
        ("callbacks.stop.patience=3",
         "callbacks.stop must have _target_, the dotted name of what it configures; got none"),
        ("callbacks.stop._target_=lightning.Stopp",
         "_target_ must be the dotted name of a class or function; got 'lightning.Stopp': module 'lightning' has no "
         "attribute 'Stopp'"),
        ("optimizer._target_=torch.optim.lr_scheduler.StepLR", "optimizer.step_size must be given"),
        ("~trainer.schedule", "trainer.schedule must be given"),
        ("+data.sensor.edge_dropout=2", "data.sensor.edge_dropout must be at least 0 and at most 1; got 2"),
        ("object.diameter=-1", "object.diameter must be a number greater than 0 and at most 10; got -1"),
        ("+object.colour=red", "there is no setting 'object.colour'"),
        ("~model.classes", "model.classes can be changed, not taken away, got '~model.classes': give it a value"),
        ("+model._target_=mine.Network",
         "model._target_ must be left out or attentionvote.model.AttentionVote; got 'mine.Network'"),
        ("model.centers=[512,256]", "model.centers must have 4 entries, one a level; got [512, 256]"),
        ("object.symmetry=3",
         "object.symmetry must be a section with keys kind, axis, order, flip, flip_axis, quaternions; got 3"),
    ],
)  # fmt: skip
def test_an_impossible_value_is_one_sentence(words: str, sentence: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        compose(TrainSettings, ["object=gear", words])
    assert str(refused.value) == sentence


@pytest.mark.parametrize("plus", ["+", "++"])
def test_settings_that_conf_leaves_out_can_be_added(plus: str) -> None:
    settings = compose(TrainSettings, ["object=gear", f"{plus}data.sensor.edge_dropout=0.2"])
    assert settings.data.sensor.edge_dropout == 0.2
    assert settings.composed["data"]["sensor"] == {"preset": "gaussian", "sigma_mm": 0.3, "edge_dropout": 0.2}


def test_a_file_of_conf_model_may_name_its_class_as_before_0_2() -> None:
    plain = ["object=gear", "experiment=smoke"]
    before = compose(TrainSettings, [*plain, "+model._target_=attentionvote.model.AttentionVote"])
    assert find_training(before).directory == find_training(compose(TrainSettings, plain)).directory


def test_help_says_type_range_and_meaning_of_every_setting() -> None:
    text = help_text(TrainSettings, CONF)
    for line in (
        '  loss.settings.rotation="metric"\n      Distance of rotations, see training/pose_loss.py. '
        "[one of metric, slerp, minra, nlerp]",
        "  workers=null\n      Processes for generation and clouds; null = one per core of this machine. "
        "[a whole number at least 1 and at most 1024]",
        "  data.sensor.dropout=0.01\n      phoxi: share of points lost anywhere. [a number at least 0 and at most 1]",
    ):
        assert line in text
    assert text.count("splits never share a cycle") == 1


@pytest.mark.parametrize("key", ["tracking.store", "storage"])
def test_an_address_with_a_password_is_refused_without_saying_it(key: str) -> None:
    settings = settings_of("sweep")
    with pytest.raises(SettingError) as refused:
        check_value(settings, key, "postgresql://me:swordfish@db/mlflow")
    said = str(refused.value)
    assert said.startswith(f"{key} must not hold a password, because settings are kept with every run")
    assert "'postgresql://me:***@db/mlflow'" in said
    assert "swordfish" not in said
    check_value(settings, key, "postgresql://me@db:5432/mlflow")


def test_the_verbs_of_conf_are_scripts() -> None:
    assert [verb for verb in VERBS if not Path(SCRIPTS / f"{verb}.py").is_file()] == []
