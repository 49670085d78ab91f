"""The leaderboard of a fleet: what is known of every part's model, as rows, as a table, as files."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attentionvote.command.tables import show_table
from attentionvote.files import write_json, write_whole
from attentionvote.inference import BundleError, load_bundle
from attentionvote.registry.versions import DATA_FACT
from attentionvote.simulation.scene_set import SceneSet
from attentionvote.simulation.scene_spec import scene_set_directory
from attentionvote.workflows.train.job import TrainingJob

if TYPE_CHECKING:
    from attentionvote.registry.promotion import Standing

log = logging.getLogger("attentionvote.fleet")
_HEAD = ("part", "AP 10 %", "AP 5 %", "AP 2 %", "95 % of AP 10 %", "p50", "champion", "stale data", "state")


def row(name: str, job: TrainingJob, answers: Mapping[str, Any], bundles: Path, root: Path, store: str | None) -> dict:
    """What is known of a part's model; ``stale`` is of the champion, before there is one of the exported bundle.

    Args:
        name: of the part.
        job: the training that the configuration means now.
        answers: of the verbs, see ``MemberTask``.
        bundles: where exports lie.
        root: where scene sets lie.
        store: of MLflow.
    """
    evaluated = answers.get("evaluate") or {}
    bundle = bundles / name / "latest"
    entry: dict[str, Any] = {"object": name, "seconds": answers.get("seconds")}
    entry |= {key: evaluated.get("figures", {}).get(key) for key in ("ap_10", "ap_5", "ap_2", "latency_p50_ms")}
    entry["intervals"] = {key: evaluated.get("intervals", {}).get(key) for key in ("ap_10", "ap_5", "ap_2")}
    entry["bundle"], trained_with = None, None
    try:
        loaded = load_bundle(bundle, None)
        entry["bundle"], trained_with = loaded.digest, loaded.card.data
    except BundleError:
        pass  # nothing exported yet
    standing = _standing(store, name)
    champion = standing.champion if standing else None
    entry["champion"] = None
    if standing and champion:
        age_days = None if standing.since_s is None else round((time.time() - standing.since_s) / 86_400, 2)
        entry["champion"] = {"version": champion.number, "age_days": age_days, "bundle": champion.digest}
        # Cells run the champion, so its data are what may be stale; a version registered by hand tells none.
        tags = {name.removeprefix(DATA_FACT): tag for name, tag in champion.tags.items() if name.startswith(DATA_FACT)}
        trained_with = trained_with if champion.digest == entry["bundle"] else tags or None
    entry["stale"] = None if trained_with is None else stale_splits(trained_with, job, root)
    entry["failed"] = f"{answers['failed']}: {answers['sentence']}" if answers.get("failed") else None
    return entry


def stale_splits(trained_with: Mapping[str, str], job: TrainingJob, root: Path) -> list[str]:
    """Splits whose scenes are not those that the current configuration would generate or read.

    Args:
        trained_with: content digest of every split's scene set, from a model card.
        job: the training that the configuration means now.
        root: where scene sets lie; a set that is not there was never generated.
    """
    read = job.dataset.splits if job.dataset else {}
    stale = [split for split, scenes in read.items() if trained_with.get(split) != scenes.digest]
    for split, spec in job.specs.items():
        directory = scene_set_directory(root / "scenes", job.part.name, spec)
        now = SceneSet.open(directory).digest if SceneSet.is_complete(directory) else None
        if now is None or trained_with.get(split) != now:
            stale.append(split)
    return stale


def _standing(store: str | None, name: str) -> Standing | None:
    """Where the part's champion stands; None without a registry."""
    from attentionvote.registry.history import History
    from attentionvote.registry.promotion import stand
    from attentionvote.registry.versions import Versions

    try:
        versions = Versions(store, name)
        return stand(versions, History(versions), carry_out=False)
    except Exception as error:  # whatever the registry answers: what was measured is shown
        log.warning("the champion of %s is not known: %s", name, error)
        return None


def cells(entry: Mapping[str, Any]) -> list[str]:
    """A row as texts, in the order of the table's columns."""
    champion, sure = entry["champion"], entry["intervals"]["ap_10"]
    if champion is None:
        version_text = "none"
    else:
        other = "" if champion["bundle"] == entry["bundle"] else ", another bundle"
        age = "moved by hand" if champion["age_days"] is None else f"{champion['age_days']:.0f} d"
        version_text = f"version {champion['version']}, {age}{other}"
    figures = [entry[name] for name in ("ap_10", "ap_5", "ap_2")]
    return [
        entry["object"],
        *("" if value is None else f"{value:.3f}" for value in figures),
        "" if sure is None else f"{sure[0]:.3f} to {sure[1]:.3f}",
        "" if entry["latency_p50_ms"] is None else f"{entry['latency_p50_ms']:.0f} ms",
        version_text,
        "" if entry["stale"] is None else ", ".join(entry["stale"]) or "no",
        entry["failed"] or "done",
    ]


def best_first(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Parts by AP at 2 %, then 5 %, then 10 % D; those without figures last."""

    def order(entry: Mapping[str, Any]) -> tuple[float, ...]:
        return tuple(-1.0 if entry[name] is None else entry[name] for name in ("ap_2", "ap_5", "ap_10"))

    return sorted(rows, key=order, reverse=True)


def show(rows: Sequence[Mapping[str, Any]]) -> None:
    """The table on stderr."""
    show_table(_HEAD, [cells(entry) for entry in rows], f"{len(rows)} parts")


def write(folder: Path, rows: Sequence[dict[str, Any]], left_out: Mapping[str, str]) -> Path:
    """leaderboard.md and leaderboard.json; the path of the first."""
    lines = ["# Fleet", "", f"| {' | '.join(_HEAD)} |", f"|{'---|' * len(_HEAD)}"]
    lines += [f"| {' | '.join(cell.replace('|', '/') for cell in cells(entry))} |" for entry in rows]
    if left_out:
        lines += ["", "Left out:", "", *(f"- {name}: {reason}" for name, reason in left_out.items())]
    path = folder / "leaderboard.md"
    write_whole(path, "\n".join(lines) + "\n")
    write_json(folder / "leaderboard.json", {"members": list(rows), "left_out": dict(left_out)})
    return path
