"""What the registry refers to: asked before anything is removed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from attentionvote.registry.versions import DATA_FACT, Versions
from attentionvote.tracking.store import resolve_store, shown


@dataclass(frozen=True)
class References:
    """What the versions of a part name.

    Attributes:
        runs: of the trainings.
        bundles: digests.
        scenes: digests of the scenes that they were trained with.
        evaluations: digests of the sets that they were judged on.
    """

    runs: set[str] = field(default_factory=set)
    bundles: set[str] = field(default_factory=set)
    scenes: set[str] = field(default_factory=set)
    evaluations: set[str] = field(default_factory=set)


def references(store: str | None, part: str, runs: Iterable[str]) -> tuple[References, Mapping[str, bool]]:
    """What a part's versions name, and which of some runs the store has; nothing is created.

    Args:
        store: see :func:`attentionvote.tracking.store.resolve_store`.
        part: its name.
        runs: ids of runs.

    Raises:
        ConnectionError: with one sentence, when there is no store or it does not answer.
        ValueError: when its URI is impossible.
    """
    uri = resolve_store(store)
    if uri.startswith("sqlite:///") and not Path(uri.removeprefix("sqlite:///")).is_file():
        raise ConnectionError(f"tracking store {shown(uri)} must be there, but it is not: name it with tracking.store")
    try:
        versions = Versions(store, part)
        registered = versions.all()
        has_runs = {run_id: versions.has_run(run_id) for run_id in runs}
    except Exception as error:  # MLflow's, SQLAlchemy's: whatever a store that is away answers
        sentence = str(error).strip().partition("\n")[0]
        raise ConnectionError(sentence if shown(uri) in sentence else f"{shown(uri)}: {sentence}") from error
    data = {digest for v in registered for name, digest in v.tags.items() if name.startswith(DATA_FACT)}
    judged = {version.tags["evaluation.set"] for version in registered if "evaluation.set" in version.tags}
    named = References({v.run_id for v in registered} - {""}, {v.digest for v in registered} - {""}, data, judged)
    return named, has_runs
