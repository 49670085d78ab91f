"""Help of a verb: its docstring, its groups with their choices, and every setting with default, meaning and range."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from omegaconf import OmegaConf

from attentionvote.command.conf_folder import choices, primary_groups
from attentionvote.command.configuration import VerbSettings, compose, leaves
from attentionvote.command.errors import ConfigurationError
from attentionvote.section import find
from attentionvote.setting import Setting


def help_text(settings: type[VerbSettings], conf: Path) -> str:
    """What ``--help`` prints.

    Args:
        settings: of the verb.
        conf: folder of the configuration files.
    """
    verb = settings.verb
    lines = [(sys.modules["__main__"].__doc__ or verb).strip(), ""]
    groups = primary_groups(verb, conf)
    lines += [f"  {name}=  {' | '.join(choices(name, conf))}" for name in groups if (conf / name).is_dir()]
    mandatory = [f"{g}={choices(g, conf)[0]}" for g, v in groups.items() if v == "???" and choices(g, conf)]
    try:
        composed = compose(settings, mandatory, conf).composed
    except ConfigurationError:  # e.g. a mandatory setting: show what the file itself holds
        primary = OmegaConf.to_container(OmegaConf.load(conf / f"{verb}.yaml"), resolve=False)
        assert isinstance(primary, dict)
        composed = {str(key): value for key, value in primary.items() if key not in ("defaults", "hydra")}
    lines += ["", "Settings (key=value) and their defaults:"]
    for key, value in leaves(composed):
        lines.append(f"  {key}={json.dumps(value, ensure_ascii=False)}")
        field = find(settings, key, composed)
        if field is not None and (text := _meaning(field.setting)):
            lines.append(f"      {text}")
    return "\n".join([*lines, "", "A comma-separated list of values with -m runs a grid (Hydra's multirun)."])


def _meaning(setting: Setting) -> str:
    """What a setting means and may be, on one line."""
    allowed = setting.range_text()
    return f"{setting.help} [{allowed}]" if allowed and setting.help else setting.help or allowed
