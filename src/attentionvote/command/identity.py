"""The settings that identify a result: a training, a grid, a trial."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from attentionvote.command.configuration import VerbSettings
from attentionvote.section import find, is_target, located
from attentionvote.setting import Identity, fields_of, without_null

NETWORK = "attentionvote.model.AttentionVote"  # the class that conf/model named before 0.2


def identity(settings: VerbSettings, *, once: bool = False) -> dict[str, Any]:
    """The plain settings that identify a result (see ``setting.Identity``), as they were composed.

    Args:
        settings: of a verb.
        once: whether those count that did in earlier versions.
    """
    plain = _identifying(type(settings), settings.composed, once)
    if "model" in plain:  # a training keeps its identity
        plain["model"]["_target_"] = NETWORK
    return plain


def identifies(settings: type[VerbSettings], key: str, values: Mapping[str, Any] | None = None) -> bool:
    """Whether a dotted key is of a setting that identifies a result.

    Args:
        settings: of a verb.
        key: of a setting.
        values: of the settings, which tell the ``_target_`` of a section that has one.
    """
    names = key.split(".")
    fields = (find(settings, ".".join(names[: count + 1]), values) for count in range(len(names)))
    return not any(field and field.setting.identity in (Identity.NEVER, Identity.ONCE) for field in fields)


def _identifying(section: Any, values: Mapping[str, Any], once: bool) -> dict[str, Any]:
    fields = fields_of(section)
    plain: dict[str, Any] = {}
    for name, value in values.items():
        field = fields.get(name)
        if field is not None:
            counts = field.setting.identity
            if counts is Identity.NEVER or (counts is Identity.ONCE and not once):
                continue
            if counts is Identity.CHANGED and value == field.default:
                continue
            inner, _ = without_null(field.type)
            if isinstance(value, Mapping) and dataclasses.is_dataclass(inner):
                value = _identifying(located(str(value["_target_"])) if is_target(inner) else inner, value, once)
        plain[name] = value
    return plain
