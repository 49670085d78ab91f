"""The space that a sweep searches: declared as data, checked against the known settings before any work."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from typing import TYPE_CHECKING, Any

from attentionvote.command.configuration import leaves
from attentionvote.command.errors import ConfigurationError, nearest
from attentionvote.command.identity import identifies
from attentionvote.section import check_value
from attentionvote.section import leaves as fields_below
from attentionvote.setting import Setting as AnySetting
from attentionvote.setting import SettingError, scalar_problem
from attentionvote.workflows.train.job import find_training
from attentionvote.workflows.train.settings import TrainSettings

if TYPE_CHECKING:
    from optuna.trial import Trial

_FIELDS = {"float": ("low", "high", "log"), "int": ("low", "high", "log"), "categorical": ("choices",)}


@dataclass(frozen=True)
class Setting:
    """One setting that is searched.

    Args:
        name: dotted, of a training's configuration.
        kind: ``float`` or ``int`` between ``low`` and ``high`` (both included), ``categorical`` among ``choices``.
        log: whether the logarithm is searched.
    """

    name: str
    kind: str
    low: float = 0
    high: float = 0
    log: bool = False
    choices: tuple[Any, ...] = ()

    def suggest(self, trial: Trial) -> Any:
        """The value of a trial: drawn by the study's sampler, or the one that the trial has."""
        if self.kind == "float":
            return trial.suggest_float(self.name, self.low, self.high, log=self.log)
        if self.kind == "int":
            return trial.suggest_int(self.name, int(self.low), int(self.high), log=self.log)
        labels = [_label(choice) for choice in self.choices]
        return self.choices[labels.index(trial.suggest_categorical(self.name, labels))]

    def value(self, stored: Any) -> Any:
        """The setting's value for what a study has stored: lists are stored as texts."""
        return next((c for c in self.choices if _label(c) == stored), stored)

    def word(self, value: Any) -> str:
        """The override for a command line."""
        return f"{self.name}={json.dumps(value)}"

    @property
    def extremes(self) -> tuple[Any, ...]:
        """The values that must be possible for all to be."""
        return self.choices or (self.low, self.high)


def _label(choice: Any) -> Any:
    return choice if choice is None or isinstance(choice, (bool, int, float, str)) else json.dumps(choice)


def parse_space(entries: Sequence[Mapping[str, Any]], base: TrainSettings) -> list[Setting]:
    """The settings of a space.

    Args:
        entries: ``{name, kind, low, high, log}`` or ``{name, kind: categorical, choices}``.
        base: the configuration of the training that they change.

    Raises:
        ConfigurationError: with one sentence, when an entry is unknown, impossible or out of range.
    """
    left_out = {key: field.default for key, field in fields_below(TrainSettings) if field.default is not ...}
    defaults = left_out | dict(leaves(base.composed))
    if not entries:
        raise ConfigurationError("sweep.space must have at least one setting, got none")
    settings = [_setting(entry, defaults) for entry in entries]
    names = [setting.name for setting in settings]
    for name in names:
        if names.count(name) > 1:
            raise ConfigurationError(
                f"sweep.space must name every setting once, got {name!r} {names.count(name)} times"
            )
    for setting in settings:
        for value in setting.extremes:
            _try(setting, value, base)
    return settings


def _setting(entry: Any, defaults: Mapping[str, Any]) -> Setting:
    if not isinstance(entry, Mapping) or not isinstance(entry.get("name"), str):
        raise ConfigurationError(f"every entry of sweep.space must be a section with a name and a kind, got {entry!r}")
    name, kind = entry["name"], entry.get("kind")
    where = f"sweep.space, {name}"
    if name not in defaults:
        raise ConfigurationError(f"sweep.space must name settings of a training, got {name!r}{nearest(name, defaults)}")
    if name.startswith("object.") or not identifies(TrainSettings, name):
        what = "the part" if name.startswith("object.") else "how a training is run"
        raise ConfigurationError(f"sweep.space must name settings of what is learned, but {name!r} is about {what}")
    if kind not in _FIELDS:
        hint = nearest(str(kind), _FIELDS)
        raise ConfigurationError(f"{where}: kind must be one of {', '.join(_FIELDS)}; got {kind!r}{hint}")
    for field in entry:
        if field not in ("name", "kind", *_FIELDS[kind]):
            hint = nearest(str(field), ("name", "kind", *_FIELDS[kind]))
            raise ConfigurationError(f"{where}: {kind} takes {', '.join(_FIELDS[kind])}; there is no {field!r}{hint}")
    values = _choices(entry, where) if kind == "categorical" else _bounds(entry, where, kind)
    for value in values:
        try:
            check_value(TrainSettings, name, value)
        except (ConfigurationError, SettingError) as error:
            raise ConfigurationError(f"sweep.space: {error}") from None
    if kind == "float" and isinstance(defaults[name], int):
        raise ConfigurationError(f"{where}: kind must be int, because {defaults[name]} is a whole number; got 'float'")
    if kind == "categorical":
        return Setting(name, kind, choices=tuple(values))
    return Setting(name, kind, values[0], values[1], bool(entry.get("log", False)))


def _choices(entry: Mapping[str, Any], where: str) -> list[Any]:
    choices = entry.get("choices")
    if not isinstance(choices, list) or len(choices) < 2:
        raise ConfigurationError(f"{where}: choices must be a list of at least two, got {choices!r}")
    labels = [_label(choice) for choice in choices]
    for label in labels:
        if labels.count(label) > 1:
            raise ConfigurationError(f"{where}: choices must differ, got {label!r} {labels.count(label)} times")
    return choices


def _bounds(entry: Mapping[str, Any], where: str, kind: str) -> list[Any]:
    bounds: list[Any] = []
    for field in ("low", "high"):
        bounds.append(entry.get(field))
        problem = scalar_problem(bounds[-1], int if kind == "int" else float, AnySetting(""), False)
        if problem:
            raise ConfigurationError(f"{where}: {field} must be {problem}")
    low, high = bounds
    if not low < high:
        raise ConfigurationError(f"{where}: low must be less than high, got {low} and {high}")
    if not isinstance(entry.get("log", False), bool):
        raise ConfigurationError(f"{where}: log must be true or false, got {entry['log']!r}")
    if entry.get("log") and not low > 0:
        raise ConfigurationError(f"{where}: low must be greater than 0 where the logarithm is searched, got {low}")
    return bounds


def _try(setting: Setting, value: Any, base: TrainSettings) -> None:
    """Refuse a value that does not fit the rest of the configuration."""
    changed = deepcopy(base.composed)
    *sections, leaf = setting.name.split(".")
    reduce(getitem, sections, changed)[leaf] = value
    try:
        find_training(type(base).of(changed))
    except (ValueError, OSError) as error:
        raise ConfigurationError(f"sweep.space, {setting.name}={json.dumps(value)}: {error}") from error
