"""Figures that come after a run has ended, such as those of its exported model."""

from __future__ import annotations

import time
from collections.abc import Mapping

from attentionvote.tracking.metric_writer import metric_name
from attentionvote.tracking.store import connect, resolve_store, shown


def add_to_run(
    store: str | None, run_id: str, metrics: Mapping[str, float], tags: Mapping[str, str], texts: Mapping[str, str]
) -> None:
    """Add metrics, tags and text files to a run, whatever its state, which stays.

    Args:
        store: see :func:`attentionvote.tracking.store.resolve_store`.
        run_id: of the run.
        metrics: added at step 0; a later value of a name is the one that is shown.
        tags: the newest value counts.
        texts: content by artefact name, in place of an older one.

    Raises:
        ValueError: the store cannot be used or has no such run.
        ConnectionError: the tracking server does not answer.
    """
    uri = resolve_store(store)
    client = connect(uri)
    from mlflow.entities import Metric, RunTag
    from mlflow.exceptions import MlflowException

    now = int(1000 * time.time())
    try:
        client.get_run(run_id)
        client.log_batch(
            run_id,
            metrics=[Metric(metric_name(name), float(value), now, 0) for name, value in metrics.items()],
            tags=[RunTag(name, value) for name, value in tags.items()],
        )
        for name, text in texts.items():
            client.log_text(run_id, text, name)
    except MlflowException as error:
        reason = str(error).strip().split("\n")[0]
        raise ValueError(f"run {run_id} must be in {shown(uri)} to add figures to it, but: {reason}") from error
