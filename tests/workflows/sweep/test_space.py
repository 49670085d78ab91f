"""The search space: what is refused before any work, and what a trial makes of it."""

from __future__ import annotations

from typing import Any

import optuna
import pytest

from attentionvote.command.conf_folder import CONF, choices
from attentionvote.command.configuration import compose, leaves
from attentionvote.command.errors import ConfigurationError
from attentionvote.workflows.sweep.settings import SweepSettings
from attentionvote.workflows.sweep.space import parse_space
from attentionvote.workflows.train.settings import TrainSettings

RATE = {"name": "trainer.learning_rate", "kind": "float", "low": 0.001, "high": 0.01, "log": True}


@pytest.fixture(scope="module")
def base() -> TrainSettings:
    return compose(TrainSettings, ["object=brick", "experiment=smoke"])


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"name": "trainer.learning_rat"}, "got 'trainer.learning_rat', did you mean 'trainer.learning_rate'?"),
        ({"kind": "float"}, "every entry of sweep.space must be a section with a name and a kind, got {'kind'"),
        ({"name": "outputs", "kind": "categorical"}, "'outputs' is about how a training is run"),
        ({"name": "object.diameter", "kind": "float"}, "'object.diameter' is about the part"),
        ({**RATE, "kind": "flaot"}, "kind must be one of float, int, categorical; got 'flaot', did you mean 'float'?"),
        ({**RATE, "choises": [1, 2]}, "float takes low, high, log; there is no 'choises'"),
        ({**RATE, "hihg": 1}, "there is no 'hihg', did you mean 'high'?"),
        ({**RATE, "low": 0.01}, "trainer.learning_rate: low must be less than high, got 0.01 and 0.01"),
        ({**RATE, "low": 0.0}, "low must be greater than 0 where the logarithm is searched, got 0.0"),
        ({**RATE, "high": 11}, "trainer.learning_rate must be greater than 0 and at most 10; got 11"),
        ({**RATE, "low": "abc"}, "low must be a finite number; got 'abc'"),
        ({k: v for k, v in RATE.items() if k != "high"}, "high must be a finite number; got None"),
        ({**RATE, "log": "yes"}, "log must be true or false, got 'yes'"),
        ({"name": "trainer.batch_size", "kind": "int", "low": 1.5, "high": 3}, "low must be a whole number; got 1.5"),
        (
            {"name": "trainer.batch_size", "kind": "float", "low": 1, "high": 3},
            "trainer.batch_size: kind must be int, because 4 is a whole number; got 'float'",
        ),
        (
            {"name": "trainer.batch_size", "kind": "int", "low": 1, "high": 40},
            "trainer.batch_size=40: trainer.batch_size must be at most the 12 training scenes, got 40",
        ),
        (
            {"name": "loss.settings.rotation", "kind": "categorical", "choices": ["metric", "slarp"]},
            "loss.settings.rotation must be one of .*; got 'slarp', did you mean 'slerp'?",
        ),
        ({"name": "data.augmentation.roll", "kind": "categorical", "choices": [True, 3]}, "true or false; got 3"),
        ({"name": "trainer.optimizer", "kind": "categorical", "choices": ["adam"]}, "choices must be a list"),
        ({"name": "seed", "kind": "categorical", "choices": [1, 1]}, "choices must differ, got 1 2 times"),
    ],
)  # fmt: skip
def test_an_impossible_entry_is_one_sentence(base: TrainSettings, entry: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message.replace("?", r"\?").replace("{'", r"\{'")) as error:
        parse_space([entry], base)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith("sweep.space") or "sweep.space" in str(error.value)


def test_an_empty_space_and_a_name_twice_are_refused(base: TrainSettings) -> None:
    with pytest.raises(ConfigurationError, match="at least one setting, got none"):
        parse_space([], base)
    with pytest.raises(ConfigurationError, match=r"every setting once, got 'trainer.learning_rate' 2 times"):
        parse_space([RATE, RATE], base)


def test_every_kind_gives_values_and_words_that_compose(base: TrainSettings) -> None:
    space = parse_space(
        [
            RATE,
            {"name": "trainer.batch_size", "kind": "int", "low": 2, "high": 4},
            {"name": "trainer.schedule.milestones", "kind": "categorical", "choices": [[2, 3], [4, 5]]},
            {"name": "model.merge_fraction", "kind": "categorical", "choices": [None, 0.1]},
            {"name": "data.augmentation.roll", "kind": "categorical", "choices": [True, False]},
            {"name": "trainer.optimizer", "kind": "categorical", "choices": ["adam", "adamw"]},
        ],
        base,
    )
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    seen = set()
    for _ in range(12):
        trial = study.ask()
        values = {setting.name: setting.suggest(trial) for setting in space}
        seen |= {str(values["model.merge_fraction"]), str(values["trainer.schedule.milestones"])}
        study.tell(trial, 0.0)
    assert seen == {"None", "0.1", "[2, 3]", "[4, 5]"}
    cfg = compose(TrainSettings, ["object=brick", "experiment=smoke", *(s.word(values[s.name]) for s in space)])
    plain = dict(leaves(cfg.composed))
    assert {s.name: plain[s.name] for s in space} == values
    stored = study.trials[-1].params
    assert {s.name: s.value(stored[s.name]) for s in space} == values


def test_a_setting_that_conf_leaves_out_is_searched_too(base: TrainSettings) -> None:
    entry = {"name": "trainer.accumulate_grad_batches", "kind": "int", "low": 1, "high": 2}
    (setting,) = parse_space([entry], base)
    words = ["object=brick", "experiment=smoke", "trainer.accumulate_grad_batches=2"]
    assert compose(TrainSettings, words).trainer.accumulate_grad_batches == 2
    assert setting.extremes == (1, 2)


@pytest.mark.parametrize("name", choices("sweep"))
def test_the_spaces_of_conf_fit_the_preset_of_their_name(name: str) -> None:
    assert (CONF / "experiment" / f"{name}.yaml").is_file()
    space = compose(SweepSettings, ["object=brick", f"sweep={name}"]).sweep.space
    assert isinstance(space, list)
    assert len(parse_space(space, compose(TrainSettings, ["object=brick", f"experiment={name}"]))) == len(space)
