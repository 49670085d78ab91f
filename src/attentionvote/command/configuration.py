"""From ``conf/`` and the words on the command line to one checked configuration.

Hydra composes; this module turns everything that can be wrong with the result into one sentence
with the nearest valid name, before any work starts:

* a group choice that does not exist (``object=conecting_rod``) or a group that must be chosen;
* a setting that does not exist (``trainer.max_epoch=3``, ``lr=1``);
* a value of another type than the default it replaces (``trainer.learning_rate=abc``);
* a value outside its range (on its field, see ``setting.py``);
* an interpolation or a mandatory value that cannot be resolved.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.override_parser.types import Override
from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError  # type: ignore[import-untyped]

from attentionvote.command.conf_folder import CONF, choices, groups
from attentionvote.command.errors import ConfigurationError, nearest, sentence
from attentionvote.command.words import parse
from attentionvote.section import find, read
from attentionvote.setting import SettingError, without_null


def leaves(node: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every dotted key below ``node`` (plain containers) with its value; empty mappings count as values."""
    if isinstance(node, Mapping) and node:
        for key, value in node.items():
            yield from leaves(value, f"{prefix}.{key}" if prefix else str(key))
    elif prefix:
        yield prefix, node


@dataclass(frozen=True)
class VerbSettings:
    """Settings of a verb: a subclass has a field for every key of ``conf/<verb>.yaml`` and the groups it chooses.

    Attributes:
        verb: stem of the configuration file.
        composed: plain containers as Hydra composed them, every interpolation resolved: what identities are made of.
    """

    verb: ClassVar[str]
    composed: dict[str, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> Self:
        """Settings of plain containers.

        Raises:
            SettingError: on the first that is unknown, missing, of another type or out of its range.
        """
        settings = read(cls, plain)
        object.__setattr__(settings, "composed", dict(plain))
        return settings

    def yaml(self) -> str:
        """The settings as a configuration file."""
        return str(OmegaConf.to_yaml(OmegaConf.create(self.composed)))


Settings = TypeVar("Settings", bound=VerbSettings)


def compose(settings: type[Settings], overrides: Sequence[str], conf: Path = CONF) -> Settings:
    """The checked settings of a verb with ``overrides``, every interpolation resolved.

    Raises:
        ConfigurationError: with one sentence, see the module's docstring.
    """
    verb = settings.verb
    parsed = parse(overrides)
    group_words = [o for o in parsed if o.input_line and (conf / o.key_or_group).is_dir()]
    for override in group_words:
        _check_choice(override, conf)
    values = [o for o in parsed if o not in group_words and o.key_or_group.split("/")[0].split(".")[0] != "hydra"]
    if values:
        base = _defaults(verb, tuple(str(o.input_line) for o in parsed if o not in values), conf, _state(conf))
        for override in values:
            _check_key(settings, override, base, conf)
    final = _plain(_compose(verb, overrides, conf))
    for override in values:
        key = override.key_or_group
        if not (override.is_add() or override.is_force_add() or override.is_delete()):
            check_types(settings, key, _select(base, key), _final_value(final, override), base)
    try:
        return settings.of(final)
    except SettingError as error:
        raise ConfigurationError(sentence(error)) from error


@lru_cache(maxsize=64)
def _defaults(verb: str, group_words: tuple[str, ...], conf: Path, _: object) -> dict[str, Any]:
    """What the values replace, not to be changed: a third of a second that a fleet of parts or a sweep pays once."""
    return _plain(_compose(verb, group_words, conf))


def _state(conf: Path) -> tuple[tuple[str, int, int], ...]:
    """What tells that a file of the configuration has changed, as a part does that is added."""
    stats = ((path, path.stat()) for path in sorted(conf.rglob("*.yaml")))
    return tuple((str(path), facts.st_mtime_ns, facts.st_size) for path, facts in stats)


def _compose(verb: str, overrides: Sequence[str], conf: Path) -> DictConfig:
    try:
        with initialize_config_dir(str(conf), version_base="1.3", job_name=verb):
            return hydra_compose(verb, list(overrides))
    except MissingConfigException as error:
        group, _, name = (error.missing_cfg_file or "").rpartition("/")
        if group and (conf / group).is_dir():
            raise ConfigurationError(_choice_problem(group, name, conf)) from error
        raise ConfigurationError(sentence(error).split(" Config search path")[0]) from error
    except ConfigCompositionException as error:
        text = sentence(error)
        if text.startswith("You must specify"):
            group = text.split("'")[1]
            raise ConfigurationError(f"{group} must be given, one of {', '.join(choices(group, conf))}") from error
        raise ConfigurationError(text) from error
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        raise ConfigurationError(sentence(error)) from error


def _plain(cfg: DictConfig) -> dict[str, Any]:
    try:
        missing = sorted(OmegaConf.missing_keys(cfg))
        plain = OmegaConf.to_container(cfg, resolve=True)
    except OmegaConfBaseException as error:
        reason = sentence(error).split(" full_key")[0]
        raise ConfigurationError(f"{getattr(error, 'full_key', None)} cannot be resolved: {reason}") from error
    if missing:
        raise ConfigurationError(f"{missing[0]} must be given, e.g. {missing[0]}=VALUE")
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items()}


def _choice_problem(group: str, name: str, conf: Path) -> str:
    valid = choices(group, conf)
    return f"{group} must be one of {', '.join(valid)}; got {name!r}{nearest(name, valid)}"


def _check_choice(override: Override, conf: Path) -> None:
    if override.is_sweep_override():
        raise ConfigurationError(f"{override.input_line} lists several choices, which needs -m (a grid of runs)")
    if override.is_delete():
        return
    value = override.value()
    for name in value if isinstance(value, list) else [value]:
        if str(name) not in choices(override.key_or_group, conf):
            shown = "null" if name is None else str(name)
            raise ConfigurationError(_choice_problem(override.key_or_group, shown, conf))


def _check_key(settings: type[VerbSettings], override: Override, base: dict[str, Any], conf: Path) -> None:
    key = override.key_or_group
    if override.is_add() or override.is_force_add():
        return
    field = find(settings, key, base)
    if override.is_delete() and field is not None and field.default is not ...:
        raise ConfigurationError(f"{key} can be changed, not taken away, got {override.input_line!r}: give it a value")
    try:
        _select(base, key)
    except KeyError:
        if field is not None and field.default is not ...:
            raise ConfigurationError(f"{key} is not in conf/, so it is added: +{override.input_line}") from None
        keys = [k for k, _ in leaves(base)]
        sections = {k.rsplit(".", n)[0] for k in keys for n in range(1, k.count(".") + 1)}
        hint = nearest(key, [*(g for g in groups(conf) if "." not in key), *keys, *sorted(sections)])
        raise ConfigurationError(f"there is no setting {key!r}{hint}") from None


def _select(plain: Any, key: str) -> Any:
    node = plain
    for name in key.split("."):
        if isinstance(node, list) and name.isdigit() and int(name) < len(node):
            node = node[int(name)]
        elif isinstance(node, Mapping) and name in node:
            node = node[name]
        else:
            raise KeyError(key)
    return node


def _final_value(final: dict[str, Any], override: Override) -> Any:
    """The value that an override has in the end."""
    try:
        return _select(final, override.key_or_group)
    except KeyError:
        raise ConfigurationError(
            f"{override.input_line} must stay in the configuration, but another word takes its section away: leave one "
            "of them out"
        ) from None


def check_types(
    settings: type[VerbSettings], key: str, default: Any, value: Any, values: Mapping[str, Any] | None = None
) -> None:
    """Refuse ``value`` where it has another type than ``default``, with the default as an example.

    Null is left to the setting's own type, on both sides.

    Args:
        values: of the settings, see ``section.find``.
    """
    setting = find(settings, key, values)
    nullable = setting is not None and without_null(setting.type)[1]
    if default is None or (value is None and nullable):
        return
    if isinstance(default, Mapping):
        if not isinstance(value, Mapping):
            names = ", ".join(map(str, default))
            raise ConfigurationError(f"{key} must be a section with keys {names}; got {_shown(value)}")
        for name in value:
            if name in default:
                check_types(settings, f"{key}.{name}", default[name], value[name], values)
        return
    if isinstance(default, list):
        if not isinstance(value, list):
            raise ConfigurationError(f"{key} must be a list such as {default}; got {_shown(value)}")
        if default and not value:
            raise ConfigurationError(f"{key} must not be empty, a list such as {default}; got []")
        for index, item in enumerate(value if default else ()):
            check_types(settings, f"{key}[{index}]", default[min(index, len(default) - 1)], item, values)
        return
    problem = type_problem(default, value)
    if problem:
        example = f" such as {default}" if default != "" else ""
        raise ConfigurationError(f"{key} must be {problem}{example}; got {_shown(value)}")


def _shown(value: Any) -> str:
    return "null" if value is None else repr(value)


def type_problem(default: object, value: object) -> str:
    """What ``value`` should have been to replace ``default``, or an empty string when it fits."""
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if isinstance(default, bool):
        return "" if isinstance(value, bool) else "true or false,"
    if isinstance(default, int):
        return "" if number and not isinstance(value, float) else "a whole number"
    if isinstance(default, float):
        return "" if number and math.isfinite(float(value)) else "a finite number"  # type: ignore[arg-type]
    return "" if isinstance(value, str) else "a text"
