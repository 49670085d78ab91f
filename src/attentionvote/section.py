"""Sections of settings: read from plain values into dataclasses, searched by dotted names, checked."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Collection, Iterator, Mapping, Sequence
from difflib import get_close_matches
from importlib import import_module
from typing import Any, ClassVar, Self, TypeVar, get_args, get_origin

from attentionvote.setting import (
    Field,
    Identity,
    Setting,
    SettingError,
    fields_of,
    scalar_problem,
    takes_any_name,
    wanted,
    without_null,
)

_Section = TypeVar("_Section")


def find(section: Any, key: str, values: Any = None) -> Field | None:
    """The setting of a dotted key below a section; None where there is none.

    Args:
        section: a dataclass, or a function that a ``_target_`` names.
        key: an index in brackets (``widths[0]``) is left aside; keys of a dict have the type of its values.
        values: of the section, which tell the ``_target_`` of a section that has one.
    """
    field = Field(section, Setting(""), ...)
    for name in key.split("."):
        type_, _ = without_null(field.type)
        inside = isinstance(values, Mapping)
        if is_target(type_):
            if not inside or "_target_" not in values:
                return None
            type_ = located(str(values["_target_"]))
        values = values.get(name) if inside else None
        if get_origin(type_) in (dict, Mapping):
            field = Field(get_args(type_)[1], field.setting, ...)
            continue
        fields = fields_of(type_) if dataclasses.is_dataclass(type_) or inspect.isroutine(type_) else {}
        if name.partition("[")[0] not in fields:
            return None
        field = fields[name.partition("[")[0]]
    return field


@dataclasses.dataclass(frozen=True)
class Target:
    """A section that names with ``_target_`` what it configures; calling it makes that.

    Args:
        path: dotted name of a class or function.
        arguments: its keyword arguments, as the section has them.
    """

    path: str
    arguments: Mapping[str, Any]
    given: ClassVar[int] = 0  # parameters, the first ones, that whoever calls it fills

    @classmethod
    def of(cls, values: Mapping[str, Any], key: str = "") -> Self:
        """A section of plain values, checked against the signature of its target.

        Raises:
            SettingError: as ``read``.
        """
        if "_target_" not in values:
            raise SettingError(
                f"{key or 'a section'} must have _target_, the dotted name of what it configures; got none"
            )
        for name in ("_args_", "_partial_"):
            if name in values and not (cls.given and values[name] is True):
                raise SettingError(f"{key or 'a section'} takes its arguments by name, got {name}: leave it out")
        # _recursive_ and _convert_ steer Hydra's own way of calling a target.
        arguments = {str(name): item for name, item in values.items() if not str(name).startswith("_")}
        path = str(values["_target_"])
        _arguments(located(path), arguments, key, cls.given)
        if values.get("_recursive_", True):
            for name, item in arguments.items():
                if isinstance(item, Mapping) and "_target_" in item:
                    arguments[name] = Target.of(item, f"{key}.{name}" if key else name)
        return cls(path, arguments)

    @property
    def name(self) -> str:
        """The argument ``name``."""
        return str(self.arguments["name"])

    @property
    def parameters(self) -> Collection[str]:
        """What the target can be given by name."""
        return fields_of(located(self.path)).keys()

    def __call__(self, *first: Any, **more: Any) -> Any:
        """What the section configures; errors are those of its target.

        Args:
            first: a factory's first arguments.
            more: arguments for those that the section leaves out.
        """
        made = {name: item() if isinstance(item, Target) else item for name, item in self.arguments.items()}
        return located(self.path)(*first, **{**more, **made})


@dataclasses.dataclass(frozen=True)
class Factory(Target):
    """A section whose target is given its first argument when it is called: an optimizer the weights, for one.

    ``_partial_: true``, which Hydra wants there, may stand in it.
    """

    given: ClassVar[int] = 1


def is_target(type_: Any) -> bool:
    """Whether a setting of this type is a section with ``_target_``."""
    return isinstance(type_, type) and issubclass(type_, Target)


def located(path: str) -> Any:
    """The class or function of a ``_target_``.

    Raises:
        SettingError: when there is none.
    """
    module, _, name = path.rpartition(".")
    try:
        target = getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise SettingError(f"_target_ must be the dotted name of a class or function; got {path!r}: {error}") from error
    if not callable(target):
        raise SettingError(f"_target_ must be the dotted name of a class or function; got {path!r}")
    return target


def read(section: type[_Section], values: Mapping[str, Any], key: str = "") -> _Section:
    """A section from plain values, in their order.

    Args:
        section: a dataclass.
        values: of plain containers, as a configuration file has them.
        key: dotted name of the section, for sentences.

    Raises:
        SettingError: the first setting that is unknown, missing, of another type or out of its range.
    """
    arguments = _arguments(section, values, key)
    try:
        return section(**arguments)
    except SettingError as error:  # each value fits, so this is of the section's own and names a field of it
        raise SettingError(f"{key}.{error}" if key else str(error)) from error
    except ValueError as error:
        raise SettingError(str(error)) from error


def check_value(section: Any, key: str, value: Any) -> None:
    """Refuse a value of one setting below a section; keys of no typed section pass.

    Args:
        section: a dataclass.
        key: dotted name of the setting.
        value: plain.

    Raises:
        SettingError: as ``read``.
    """
    field = find(section, key)
    if field is not None:
        _value(key, value, field.type, field.setting)


def check(section: Any) -> None:
    """Refuse a dataclass of settings, made in code, with a number, text or list out of its range.

    Raises:
        SettingError: as ``read``.
    """
    for name, field in fields_of(type(section)).items():
        value = getattr(section, name)
        if not dataclasses.is_dataclass(value):
            _value(name, value, field.type, field.setting)


def _arguments(section: Any, values: Mapping[str, Any], key: str, given: int = 0) -> dict[str, Any]:
    """The values of a section; the first ``given`` of its fields are none of them."""
    try:
        fields, takes_any = dict(list(fields_of(section).items())[given:]), takes_any_name(section)
    except ValueError as error:  # of a builtin, which tells nothing of its arguments
        raise SettingError(f"_target_ must be a class or function with a signature; got {section!r}") from error
    arguments = {}
    for name, value in values.items():
        inner = f"{key}.{name}" if key else name
        if name not in fields and takes_any:
            arguments[name] = value
            continue
        if name not in fields:
            close = get_close_matches(name, fields, n=1)
            hint = f", did you mean {inner.removesuffix(name) + close[0]!r}?" if close else ""
            raise SettingError(f"there is no setting {inner!r}{hint}")
        field = fields[name]
        arguments[name] = _value(inner, value, field.type, field.setting)
    for name, field in fields.items():
        if field.default is ... and name not in arguments:
            raise SettingError(f"{key}.{name} must be given" if key else f"{name} must be given")
    return arguments


def _value(key: str, value: Any, type_: Any, setting: Setting) -> Any:
    """The value as its type has it: sections as objects, lists as tuples."""
    type_, nullable = without_null(type_)
    if value is None:
        if nullable:
            return None
        raise SettingError(f"{key} must be {wanted(type_, setting, True)}; got null")
    if type_ is Any:
        if setting.problem is not None and (problem := setting.problem(value)):
            raise SettingError(f"{key} {problem}")
        return value
    origin = get_origin(type_)
    if dataclasses.is_dataclass(type_):
        if not isinstance(value, Mapping):
            raise SettingError(f"{key} must be a section{' or null' if nullable else ''}; got {value!r}")
        if is_target(type_):
            return type_.of(value, key)  # type: ignore[union-attr]
        return read(type_, value, key)  # type: ignore[arg-type]
    if origin in (dict, Mapping):
        if not isinstance(value, Mapping):
            raise SettingError(f"{key} must be a section{' or null' if nullable else ''}; got {value!r}")
        return {str(name): _value(f"{key}.{name}", item, get_args(type_)[1], setting) for name, item in value.items()}
    if origin in (tuple, Sequence, list):
        if isinstance(value, str) or not isinstance(value, Sequence):
            raise SettingError(f"{key} must be a list{' or null' if nullable else ''}; got {value!r}")
        if not (value or setting.empty):
            raise SettingError(f"{key} must not be an empty list")
        inner = get_args(type_)
        types_ = [inner[0]] * len(value) if len(inner) == 1 or inner[1] is ... else list(inner)
        if len(types_) != len(value):
            raise SettingError(f"{key} must be a list of {len(types_)}; got {list(value)}")
        return tuple(_value(key, item, t, setting) for item, t in zip(value, types_, strict=True))
    problem = scalar_problem(value, type_, setting, nullable)
    if problem:
        raise SettingError(f"{key} must be {problem}")
    if setting.problem is not None and (problem := setting.problem(value)):
        raise SettingError(f"{key} {problem}")
    return value


def identifying(section: Any) -> dict[str, Any]:
    """A section made in code as plain values, as ``dataclasses.asdict``, but for fields that came later and are at the
    default that changes nothing (``Identity.CHANGED``): digests of before they came stay the same."""
    plain = {}
    for name, field in fields_of(type(section)).items():
        value = getattr(section, name)
        if field.setting.identity is Identity.CHANGED and value == field.default:
            continue
        plain[name] = identifying(value) if dataclasses.is_dataclass(value) else value
    return plain


def leaves(section: Any, key: str = "") -> Iterator[tuple[str, Field]]:
    """Every setting below a section by its dotted key, depth first; a dict is one setting."""
    for name, field in fields_of(section).items():
        inner = f"{key}.{name}" if key else name
        type_, _ = without_null(field.type)
        if dataclasses.is_dataclass(type_) and not is_target(type_):
            yield from leaves(type_, inner)
        else:
            yield inner, field
