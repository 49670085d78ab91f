"""Settings as typed fields: range, choices and one line of help stand on the field, one walk reads and shows them.

A section of settings is a frozen dataclass, or a function that a ``_target_`` names; a setting is one of its fields or
parameters::

    points: Annotated[int, Setting("Points of a sample, N.", low=3)]

Its type is ``int``, ``float``, ``str``, ``bool``, tuples and dicts of them, another section, or one of these ``| None``
where null means something. Bounds hold for every number of a tuple or dict.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import types
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from difflib import get_close_matches
from functools import cache
from importlib import import_module
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

_Section = TypeVar("_Section")
_NOUNS = {int: "a whole number", float: "a number", str: "a text", bool: "true or false"}


class SettingError(ValueError):
    """A setting is unknown, missing, of another type or out of its range; the message is one sentence."""


@dataclasses.dataclass(frozen=True)
class ChoicesOf:
    """Choices that a module lists and that take seconds to import.

    Args:
        module, name: the collection that lists them.
        shipped: some that are known to be among them; only another value is looked up there.
    """

    module: str
    name: str
    shipped: tuple[str, ...]

    def all(self) -> tuple[str, ...]:
        """Every choice; imports the module."""
        return tuple(getattr(import_module(self.module), self.name))


@dataclasses.dataclass(frozen=True)
class Setting:
    """What one setting means and may be.

    Args:
        help: one line for people.
        low, high: inclusive bounds of its numbers.
        above: exclusive lower bound.
        choices: the texts that are allowed.
        problem: what else may be wrong with a value: a sentence's end after the setting's name, or an empty string.
    """

    help: str
    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf
    choices: tuple[str, ...] | ChoicesOf = ()
    problem: Callable[[Any], str] | None = None

    def range_text(self) -> str:
        """The range in words, empty where there is none."""
        if self.choices:
            names = self.choices.shipped if isinstance(self.choices, ChoicesOf) else self.choices
            return f"one of {', '.join(names)}"
        bounds = (("greater than", self.above), ("at least", self.low), ("at most", self.high))
        return " and ".join(f"{text} {_number(bound)}" for text, bound in bounds if math.isfinite(bound))


def _number(value: float) -> str:
    return str(int(value)) if float(value).is_integer() else f"{value:g}"


class Field(NamedTuple):
    """One setting of a section: its type without ``Annotated``, what it may be, and its default (``...`` = none)."""

    type: Any
    setting: Setting
    default: Any


def fields_of(section: Any) -> dict[str, Field]:
    """The settings of a dataclass, or of a function that a ``_target_`` names, by name."""
    return _fields_of(section)


@cache
def _fields_of(section: Any) -> dict[str, Field]:
    hints = get_type_hints(section, include_extras=True)
    if dataclasses.is_dataclass(section):
        missing = dataclasses.MISSING
        entries = [
            (f.name, ... if f.default is missing and f.default_factory is missing else f.default)
            for f in dataclasses.fields(section)
            if f.init
        ]
    else:
        parameters = inspect.signature(section).parameters.values()
        entries = [(p.name, ... if p.default is inspect.Parameter.empty else p.default) for p in parameters]
    return {name: _field(hints.get(name, Any), default) for name, default in entries}


def _field(hint: Any, default: Any) -> Field:
    setting = Setting("")
    if get_origin(hint) is Annotated:
        hint, *extras = get_args(hint)
        setting = next((extra for extra in extras if isinstance(extra, Setting)), setting)
    return Field(hint, setting, default)


def without_null(type_: Any) -> tuple[Any, bool]:
    """A type without ``None``, and whether it had it."""
    if get_origin(type_) in (Union, types.UnionType):
        members = [member for member in get_args(type_) if member is not type(None)]
        if len(members) < len(get_args(type_)):
            return (members[0] if len(members) == 1 else Union[tuple(members)]), True  # noqa: UP007
    return type_, type_ is Any


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
        if type_ is Target:
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

    @classmethod
    def of(cls, values: Mapping[str, Any], key: str = "") -> Target:
        """A section of plain values, checked against the signature of its target.

        Raises:
            SettingError: as ``read``.
        """
        if "_target_" not in values:
            raise SettingError(
                f"{key or 'a section'} must have _target_, the dotted name of what it configures; got none"
            )
        # Other keys that begin with an underscore steer Hydra's own way of calling a target.
        arguments = {str(name): item for name, item in values.items() if not str(name).startswith("_")}
        path = str(values["_target_"])
        _arguments(located(path), arguments, key)
        return cls(path, arguments)

    @property
    def name(self) -> str:
        """The argument ``name``."""
        return str(self.arguments["name"])

    def __call__(self) -> Any:
        """What the section configures; errors are those of its target."""
        return located(self.path)(**self.arguments)


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
    except SettingError:
        raise
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


def _arguments(section: Any, values: Mapping[str, Any], key: str) -> dict[str, Any]:
    fields = fields_of(section)
    arguments = {}
    for name, value in values.items():
        inner = f"{key}.{name}" if key else name
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
        raise SettingError(f"{key} must be {_wanted(type_, setting, True)}; got null")
    if type_ is Any:
        return value
    origin = get_origin(type_)
    if dataclasses.is_dataclass(type_):
        if not isinstance(value, Mapping):
            raise SettingError(f"{key} must be a section{' or null' if nullable else ''}; got {value!r}")
        if type_ is Target:
            return Target.of(value, key)
        return read(type_, value, key)  # type: ignore[arg-type]
    if origin in (dict, Mapping):
        if not isinstance(value, Mapping):
            raise SettingError(f"{key} must be a section{' or null' if nullable else ''}; got {value!r}")
        return {str(name): _value(f"{key}.{name}", item, get_args(type_)[1], setting) for name, item in value.items()}
    if origin in (tuple, Sequence, list):
        if isinstance(value, str) or not isinstance(value, Sequence):
            raise SettingError(f"{key} must be a list{' or null' if nullable else ''}; got {value!r}")
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


def scalar_problem(value: Any, type_: Any, setting: Setting, nullable: bool) -> str:
    """What a number, text or truth value should be and what it is, the end of a sentence; empty when it fits."""
    choices = get_args(type_) if get_origin(type_) is Literal else setting.choices
    if choices:
        if isinstance(value, str) and value in (choices.shipped if isinstance(choices, ChoicesOf) else choices):
            return ""
        names = choices.all() if isinstance(choices, ChoicesOf) else choices
        return "" if value in names else f"one of {', '.join(names)}; got {value!r}{_near(str(value), names)}"
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    fits = {
        bool: isinstance(value, bool),
        int: number and not isinstance(value, float),
        float: number,
        str: isinstance(value, str),
    }
    if not fits[type_]:
        return f"{_wanted(type_, setting, True)}; got {value!r}"
    if not number or (math.isfinite(value) and setting.low <= value <= setting.high and value > setting.above):
        return ""
    return f"{_wanted(type_, setting, nullable)}; got {value!r}"


def _wanted(type_: Any, setting: Setting, with_noun: bool) -> str:
    """Type and range of a setting in words."""
    if not isinstance(type_, type) or type_ not in _NOUNS:
        return "a section" if dataclasses.is_dataclass(type_) else setting.range_text() or "a list"
    bounds = setting.range_text()
    if bounds and not with_noun:
        return bounds
    noun = _NOUNS[type_] if bounds or type_ is not float else "a finite number"
    return f"{noun} {bounds}".strip()


def _near(name: str, valid: Collection[str]) -> str:
    close = get_close_matches(name, valid, n=1)
    return f", did you mean {close[0]!r}?" if close else ""


def leaves(section: Any, key: str = "") -> Iterator[tuple[str, Field]]:
    """Every setting below a section by its dotted key, depth first; a dict is one setting."""
    for name, field in fields_of(section).items():
        inner = f"{key}.{name}" if key else name
        type_, _ = without_null(field.type)
        if dataclasses.is_dataclass(type_) and type_ is not Target:
            yield from leaves(type_, inner)
        else:
            yield inner, field
