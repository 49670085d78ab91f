"""The results of a sweep: a table of its trials, what matters most, and the best settings as an experiment."""

from __future__ import annotations

import csv
import io
import json
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]
from optuna.exceptions import OptunaError
from optuna.importance import get_param_importances
from optuna.trial import FrozenTrial, TrialState

from attentionvote.command.conf_folder import is_group, new_file
from attentionvote.command.errors import ConfigurationError
from attentionvote.command.identity import identifies
from attentionvote.command.words import parse
from attentionvote.files import read_json, write_whole
from attentionvote.workflows.sweep.space import Setting
from attentionvote.workflows.sweep.study import CRASHES, Ledger
from attentionvote.workflows.train.job import RUN
from attentionvote.workflows.train.settings import TrainSettings

MARK = "Written by make sweep"  # files without it are the user's, and never replaced
_LEAST_FOR_IMPORTANCE = 4  # complete trials


def trial_row(trial: FrozenTrial, space: Sequence[Setting]) -> dict[str, Any]:
    """One trial as a row of the table: number, state, val/ap, what it tried, where its training is."""
    reported = trial.intermediate_values
    return {
        "trial": trial.number,
        "state": trial.state.name.lower(),
        "val_ap": trial.value if trial.state == TrialState.COMPLETE else None,
        "last_val_ap": reported[max(reported)] if reported else None,
        "epochs": max(reported, default=None),
        **{s.name: s.value(trial.params[s.name]) for s in space if s.name in trial.params},
        "seconds": trial.user_attrs.get("seconds"),
        "crashes": trial.user_attrs.get(CRASHES, 0),
        "directory": trial.user_attrs.get("directory"),
        "run_id": run_of(trial),
        "reason": trial.user_attrs.get("reason"),
    }


def run_of(trial: FrozenTrial) -> str | None:
    """Id of the trial's MLflow run, None while it has none."""
    run_file = Path(trial.user_attrs.get("directory", "")) / RUN
    run_id = (read_json(run_file) or {}).get("run_id") if run_file.is_file() else None
    return run_id if isinstance(run_id, str) else None


def write_table(ledger: Ledger, folder: Path) -> list[Path]:
    """``trials.json`` and ``trials.csv`` with a row a trial."""
    rows = [trial_row(trial, ledger.space) for trial in ledger.trials]
    places = [folder / "trials.json", folder / "trials.csv"]
    write_whole(places[0], json.dumps(rows, indent=2) + "\n")
    columns = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns)
    writer.writeheader()
    writer.writerows(rows)
    write_whole(places[1], text.getvalue())
    return places


def importances(ledger: Ledger) -> dict[str, float]:
    """Share of each setting in what makes a trial good (PED-ANOVA), the largest first; empty for too few trials."""
    if ledger.count(TrialState.COMPLETE) < _LEAST_FOR_IMPORTANCE:
        return {}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            shares = get_param_importances(ledger.study)
    except (ValueError, RuntimeError, OptunaError):  # all trials equally good, say
        return {}
    return {name: float(share) for name, share in shares.items()}


def experiment_text(words: Sequence[str], values: Mapping[str, Any], title: str) -> str:
    """The best settings as a file of ``conf/experiment``: what the sweep was given, and the best trial's values on top.

    Args:
        words: of the training that the sweep varies.
        values: of the searched settings.
        title: the comment at the top.

    Raises:
        ConfigurationError: when a word deletes a setting, which no such file can.
    """
    bases: list[Any] = []
    overrides: list[Any] = []
    settings: dict[str, Any] = {}
    for override in parse(words):
        key = override.key_or_group
        if override.is_delete():
            raise ConfigurationError(f"a sweep takes no word that deletes a setting, got {override.input_line!r}")
        if key == "experiment":
            bases = [] if override.value() is None else [str(override.value())]
        elif is_group(key):
            if key != "object":
                overrides.append({f"override /{key}": override.value()})
        elif identifies(TrainSettings, key):
            _put(settings, key, _plain(override.value()))
    for name, value in values.items():
        _put(settings, name, value)
    content = {"defaults": [*bases, *overrides, "_self_"], **settings}
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110)
    return f"# @package _global_\n# {title}\n# {MARK}, and by the next one again.\n{text}"


def _plain(value: Any) -> Any:
    """A parsed value without the quotes of Hydra's grammar."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    return value if value is None or isinstance(value, (bool, int, float)) else getattr(value, "text", str(value))


def _put(settings: dict[str, Any], key: str, value: Any) -> None:
    *sections, leaf = key.split(".")
    for section in sections:
        settings = settings.setdefault(section, {})
    settings[leaf] = value


def check_save_as(name: str | None, experiments: Path | None = None, words: Sequence[str] = ()) -> None:
    """Refuse a name that is no file name, that is a file of the user's, or that the experiment of the words builds on.

    Raises:
        ConfigurationError: with one sentence.
    """
    if name is None:
        return
    if not re.fullmatch(r"[\w-]+", name, re.ASCII):
        raise ConfigurationError(f"save_as must be a name of letters, digits, - and _, got {name!r}")
    experiments = experiments or new_file("experiment", name).parent
    path = experiments / f"{name}.yaml"
    if path.exists() and MARK not in path.read_text(encoding="utf-8"):
        raise ConfigurationError(
            f"save_as must not replace a file that no sweep wrote, got {name!r}: choose another name"
        )
    experiment = [o.value() for o in parse(words) if o.key_or_group == "experiment" and not o.is_delete()][-1:]
    if name in _built_on(experiment, experiments):
        raise ConfigurationError(
            f"save_as must not name an experiment that the sweep builds on, or its file would build on itself, got "
            f"{name!r}: choose another name"
        )


def _built_on(names: Sequence[Any], experiments: Path) -> set[str]:
    """The experiments of these names and all that stand in their defaults."""
    reached: set[str] = set()
    rest = [str(name) for name in names if name is not None]
    while rest:
        name = rest.pop()
        path = experiments / f"{name}.yaml"
        if name in reached or not path.is_file():
            continue
        reached.add(name)
        defaults = (yaml.safe_load(path.read_text(encoding="utf-8")) or {}).get("defaults", [])
        rest += [entry for entry in defaults if isinstance(entry, str)]
    return reached
