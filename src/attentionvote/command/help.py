"""Help of a verb: its docstring, its groups with their choices, and every setting with default, meaning and range."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_origin

from omegaconf import OmegaConf

from attentionvote.command.conf_folder import choices, is_group, primary_file, primary_groups
from attentionvote.command.configuration import VerbSettings, compose, leaves
from attentionvote.command.errors import ConfigurationError
from attentionvote.section import find
from attentionvote.section import leaves as fields_below
from attentionvote.setting import Field, wanted, without_null

_FLAGS = (
    "A comma-separated list of values with -m runs a grid (Hydra's multirun). --config-dir DIR adds a folder of yours",
    "with configuration files and modules; --config-name NAME begins with one of its files; --cfg job shows the whole.",
)


def help_text(settings: type[VerbSettings], conf: Path, name: str | None = None) -> str:
    """What ``--help`` prints.

    Args:
        settings: of the verb.
        conf: folder of the configuration files.
        name: of the configuration to begin with, else the verb's.

    Raises:
        ConfigurationError: there is no such configuration.
    """
    verb = settings.verb
    lines = [(sys.modules["__main__"].__doc__ or verb).strip(), ""]
    groups = primary_groups(name or verb, conf)
    lines += [f"  {group}=  {' | '.join(choices(group, conf))}" for group in groups if is_group(group, conf)]
    mandatory = [f"{g}={choices(g, conf)[0]}" for g, v in groups.items() if v == "???" and choices(g, conf)]
    try:
        composed = compose(settings, mandatory, conf, name).composed
    except ConfigurationError:  # e.g. a mandatory setting: show what the file itself holds
        primary = OmegaConf.to_container(OmegaConf.load(primary_file(name or verb, conf)), resolve=False)
        assert isinstance(primary, dict)
        composed = {str(key): value for key, value in primary.items() if key not in ("defaults", "hydra")}
    lines += ["", "Settings (key=value) and their defaults:"]
    shown = ""  # the dict whose meaning stands above its first key
    for key, value in leaves(composed):
        lines.append(f"  {key}={json.dumps(value, ensure_ascii=False)}")
        above, field = key.rpartition(".")[0], find(settings, key, composed)
        if field is not None and not (shown and above == shown):
            lines += _meaning(field)
        holder = find(settings, above, composed) if above else None
        shown = above if holder is not None and get_origin(holder.type) in (dict, Mapping) else ""
    known = dict(leaves(composed))
    more = [(key, f) for key, f in fields_below(settings) if f.default is not ... and not _stands(key, known)]
    if more:
        lines += ["", "Settings that conf/ leaves out:"]
        for key, field in more:
            lines += [f"  {key}={json.dumps(field.default, ensure_ascii=False, default=str)}", *_meaning(field)]
    return "\n".join([*lines, "", *_FLAGS])


def _stands(key: str, known: Mapping[str, Any]) -> bool:
    """Whether a setting, its section or what lies in it is composed."""
    return any(f"{key}.".startswith(f"{name}.") or name.startswith(f"{key}.") for name in known)


def _meaning(field: Field) -> list[str]:
    """What a setting means and may be: a line, or none."""
    allowed = wanted(without_null(field.type)[0], field.setting, True) if field.setting.help else ""
    return [f"      {field.setting.help}" + (f" [{allowed}]" if allowed else "")] if field.setting.help else []
