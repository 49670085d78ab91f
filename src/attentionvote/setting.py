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
from collections.abc import Callable, Collection
from difflib import get_close_matches
from enum import Enum
from functools import cache
from importlib import import_module
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

_VARIABLE = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
_NOUNS = {int: "a whole number", float: "a number", str: "a text", bool: "true or false"}


class SettingError(ValueError):
    """A setting is unknown, missing, of another type or out of its range; the message is one sentence."""


@dataclasses.dataclass(frozen=True)
class ChoicesOf:
    """Choices that a module lists and that take seconds to import.

    Args:
        module, name: the collection that lists them.
        shipped: some that are known to be among them; only another value is looked up there.
        classes: whether the dotted name of a class of the user's is a choice too.
    """

    module: str
    name: str
    shipped: tuple[str, ...]
    classes: bool = False

    def all(self) -> tuple[str, ...]:
        """Every choice; imports the module."""
        return tuple(getattr(import_module(self.module), self.name))


class Identity(Enum):
    """Whether a setting is part of what identifies a result, a training say.

    Attributes:
        ALWAYS: another value is another result.
        CHANGED: it is, but at its default it is left out, so that it makes no difference to results of before it came.
        NEVER: it says how the work is done, and nothing about what comes of it.
        ONCE: it is none any more; results of when it was are still recognised.
    """

    ALWAYS, CHANGED, NEVER, ONCE = range(4)


@dataclasses.dataclass(frozen=True)
class Setting:
    """What one setting means and may be.

    Args:
        help: one line for people.
        low, high: inclusive bounds of its numbers.
        above: exclusive lower bound.
        choices: the texts that are allowed.
        empty: whether a list may be empty.
        identity: whether it is part of what identifies a result.
        problem: what else may be wrong with a value: a sentence's end after the setting's name, or an empty string.
    """

    help: str
    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf
    choices: tuple[str, ...] | ChoicesOf = ()
    empty: bool = False
    identity: Identity = Identity.ALWAYS
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
    plain_class = isinstance(section, type) and not dataclasses.is_dataclass(section)
    try:
        hints = get_type_hints(section.__init__ if plain_class else section, include_extras=True)
    except NameError:  # a function of the user's, annotated with names that are imported for type checks alone
        hints = {}
    if dataclasses.is_dataclass(section):
        missing = dataclasses.MISSING
        entries = []
        for f in dataclasses.fields(section):
            default = f.default if f.default_factory is missing else f.default_factory()
            entries += [(f.name, ... if default is missing else default)] if f.init else []
    else:
        parameters = [p for p in inspect.signature(section).parameters.values() if p.kind not in _VARIABLE]
        entries = [(p.name, ... if p.default is inspect.Parameter.empty else p.default) for p in parameters]
    return {name: _field(hints.get(name, Any), default) for name, default in entries}


def takes_any_name(section: Any) -> bool:
    """Whether a function takes arguments of every name."""
    if dataclasses.is_dataclass(section):
        return False
    return any(p.kind is inspect.Parameter.VAR_KEYWORD for p in inspect.signature(section).parameters.values())


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


def scalar_problem(value: Any, type_: Any, setting: Setting, nullable: bool) -> str:
    """What a number, text or truth value should be and what it is, the end of a sentence; empty when it fits."""
    choices = get_args(type_) if get_origin(type_) is Literal else setting.choices
    if choices:
        if isinstance(value, str) and value in (choices.shipped if isinstance(choices, ChoicesOf) else choices):
            return ""
        if isinstance(choices, ChoicesOf) and choices.classes and "." in str(value):
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
    types_ = get_args(type_) if get_origin(type_) in (Union, types.UnionType) else (type_,)
    if not any(fits[one] for one in types_):
        return f"{wanted(type_, setting, True)}; got {value!r}"
    if not number or (math.isfinite(value) and setting.low <= value <= setting.high and value > setting.above):
        return ""
    return f"{wanted(type_, setting, nullable)}; got {value!r}"


def wanted(type_: Any, setting: Setting, with_noun: bool) -> str:
    """Type and range of a setting in words."""
    if get_origin(type_) is Literal:
        return f"one of {', '.join(map(str, get_args(type_)))}"
    if setting.choices:
        return setting.range_text()
    if get_origin(type_) in (Union, types.UnionType):
        return " or ".join(
            wanted(member, setting if member in (int, float) else Setting(""), True) for member in get_args(type_)
        )
    if not isinstance(type_, type) or type_ not in _NOUNS:
        section = dataclasses.is_dataclass(type_) or get_origin(type_) is dict
        return "a section" if section else setting.range_text() or "a list"
    bounds = setting.range_text()
    if bounds and not with_noun:
        return bounds
    noun = _NOUNS[type_] if bounds or type_ is not float else "a finite number"
    return f"{noun} {bounds}".strip()


def _near(name: str, valid: Collection[str]) -> str:
    close = get_close_matches(name, valid, n=1, cutoff=0.5)
    return f", did you mean {close[0]!r}?" if close else ""
