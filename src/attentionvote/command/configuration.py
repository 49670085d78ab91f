"""From ``conf/`` and the words on the command line to one checked configuration.

Hydra composes; this module turns everything that can be wrong with the result into one sentence
with the nearest valid name, before any work starts:

* a group choice that does not exist (``object=conecting_rod``) or a group that must be chosen;
* a setting that does not exist (``trainer.max_epoch=3``, ``lr=1``);
* a value of another type (``trainer.learning_rate=abc``) or outside its range (on its field, see ``setting.py``);
* an interpolation or a mandatory value that cannot be resolved.
"""

from __future__ import annotations

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

from attentionvote.command.cells import with_cell
from attentionvote.command.conf_folder import CONF, choices, files, folders, groups, is_group, primary_file
from attentionvote.command.errors import ConfigurationError, nearest, sentence
from attentionvote.command.words import parse
from attentionvote.section import find, read
from attentionvote.section import leaves as fields_below
from attentionvote.setting import SettingError


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
        words: they were composed of.
        elsewhere: what to say of names that people look for and that are no settings here.
    """

    verb: ClassVar[str]
    elsewhere: ClassVar[Mapping[str, str]] = {}
    composed: dict[str, Any] = field(default_factory=dict, init=False, repr=False, compare=False)
    words: tuple[str, ...] = field(default=(), init=False, repr=False, compare=False)

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


def compose(settings: type[Settings], overrides: Sequence[str], conf: Path = CONF, name: str | None = None) -> Settings:
    """The checked settings of a verb with ``overrides``, every interpolation resolved.

    Hydra's grammar holds, but one rule is easier: a setting that has a default and is not in ``conf/`` is set with or
    without ``+``.

    Args:
        settings: of the verb.
        overrides: words of Hydra's grammar.
        conf: folder of the configuration files; the user's stands beside it.
        name: of the configuration to begin with, else the verb's.

    Raises:
        ConfigurationError: with one sentence, see the module's docstring.
    """
    name = name or settings.verb
    primary_file(name, conf)
    parsed = parse(overrides)
    for override in parsed:
        if override.key_or_group.split("/")[0].split(".")[0] == "hydra":
            raise ConfigurationError(
                f"settings of Hydra itself have no effect, got {override.input_line!r}: leave it out (a verb runs its "
                "own work, and says where it puts things)"
            )
    group_words = [o for o in parsed if o.input_line and is_group(o.key_or_group, conf)]
    for override in group_words:
        _check_choice(override, conf)
    for override in parsed:
        name_alone = override.key_or_group.rpartition(".")[2]
        if name_alone in settings.elsewhere and not _has_default(settings, override.key_or_group, {}):
            hint = settings.elsewhere[name_alone]
            raise ConfigurationError(f"there is no setting {override.key_or_group!r}: {hint}")
    words = list(overrides)
    if len(group_words) < len(parsed):
        base = _defaults(name, tuple(str(o.input_line) for o in group_words), conf, _state(conf))
        for index, override in enumerate(parsed):
            added = override.is_add() or override.is_force_add()
            if override not in group_words and not added and _is_left_out(settings, override, base, conf):
                words[index] = f"++{override.input_line}"
    plain = _plain(_compose(name, words, conf))
    objects = tuple(str(o.input_line) for o in group_words if o.key_or_group == "object")
    try:
        keys = [o.key_or_group for o in parsed if o not in group_words]
        plain = with_cell(plain, lambda: _defaults(name, objects, conf, _state(conf)), keys)
        checked = settings.of(plain)
    except SettingError as error:
        raise ConfigurationError(sentence(error)) from error
    _check_name(checked, parsed, conf)
    object.__setattr__(checked, "words", tuple(overrides))
    return checked


def _check_name(settings: VerbSettings, parsed: Sequence[Override], conf: Path) -> None:
    """Refuse an object whose file has the name of another: its data, trainings and champion would be the other's.

    Raises:
        ConfigurationError: naming the file and both names.
    """
    chosen = [o.value() for o in parsed if o.key_or_group == "object" and o.input_line]
    if not chosen or any(o.key_or_group == "object.name" for o in parsed):
        return
    name = settings.composed.get("object", {}).get("name")
    if isinstance(chosen[-1], str) and name != chosen[-1]:
        file = next(f for folder in folders(conf) if (f := folder / "object" / f"{chosen[-1]}.yaml").is_file())
        raise ConfigurationError(
            f"name in {file} must be that of the file, {chosen[-1]!r}, got {name!r}: data, trainings and champion "
            f"would be those of {name}; correct the name, or rename the file"
        )


@lru_cache(maxsize=64)
def _defaults(name: str, group_words: tuple[str, ...], conf: Path, _: object) -> dict[str, Any]:
    """What the values replace, not to be changed: a third of a second that a fleet of parts or a sweep pays once."""
    return _plain(_compose(name, group_words, conf))


def _state(conf: Path) -> tuple[tuple[str, int, int], ...]:
    """What tells that a file of the configuration has changed, as a part does that is added."""
    paths = [folder / file for folder in folders(conf) for file in files(folder)]
    stats = ((path, path.stat()) for path in paths)
    return tuple((str(path), facts.st_mtime_ns, facts.st_size) for path, facts in stats)


def _compose(name: str, overrides: Sequence[str], conf: Path) -> DictConfig:
    primary = primary_file(name, conf)
    beside = [folder for folder in folders(conf) if folder != primary.parent]
    search = [f"hydra.searchpath=[{','.join(map(_quoted, beside))}]"] if beside else []
    try:
        with initialize_config_dir(str(primary.parent), version_base="1.3", job_name=name):
            return hydra_compose(name, [*search, *overrides])
    except MissingConfigException as error:
        group, _, name = (error.missing_cfg_file or "").rpartition("/")
        if group and is_group(group, conf):
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
    except UnicodeDecodeError as error:
        raise ConfigurationError(_not_text(conf) or sentence(error)) from error


def _not_text(conf: Path) -> str:
    """A sentence about the first configuration file that is no UTF-8 text."""
    for path in (folder / file for folder in folders(conf) for file in files(folder)):
        try:
            path.read_text(encoding="utf-8")
        except UnicodeDecodeError as error:
            line = error.object[: error.start].count(b"\n") + 1
            byte = error.object[error.start]
            return (
                f"configuration files must be UTF-8 text, but line {line} of {path} has the byte 0x{byte:02x}: save "
                "the file as UTF-8 (it may be Latin-1)"
            )
    return ""


def _quoted(folder: Path) -> str:
    """A folder as Hydra's grammar takes any text."""
    text = str(folder).replace("\\", "\\\\").replace("'", "\\'")
    return f"'file://{text}'"


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


def _is_left_out(settings: type[VerbSettings], override: Override, base: dict[str, Any], conf: Path) -> bool:
    """Whether a word sets something that has a default and is not in the configuration.

    Raises:
        ConfigurationError: there is no such setting, or it cannot be taken away.
    """
    key = override.key_or_group
    field = find(settings, key, base)
    if override.is_delete() and field is not None and field.default is not ...:
        raise ConfigurationError(f"{key} can be changed, not taken away, got {override.input_line!r}: give it a value")
    try:
        _select(base, key)
        return False
    except KeyError:
        if not override.is_delete() and _has_default(settings, key, base):
            return True
        keys = [k for k, _ in leaves(base)] + [k for k, f in fields_below(settings) if f.default is not ...]
        sections = {k.rsplit(".", n)[0] for k in keys for n in range(1, k.count(".") + 1)}
        hint = nearest(key, [*(g for g in groups(conf) if "." not in key), *dict.fromkeys(keys), *sorted(sections)])
        raise ConfigurationError(f"there is no setting {key!r}{hint}") from None


def _has_default(settings: type[VerbSettings], key: str, base: Mapping[str, Any]) -> bool:
    """Whether a setting, or an open section that it lies in, has a default."""
    names = key.split(".")
    above = [find(settings, ".".join(names[: count + 1]), base) for count in range(len(names))]
    return any(field is not None and field.default is not ... for field in above)


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
