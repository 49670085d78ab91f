"""The run above the runs of a grid or a sweep: found again by its digest, and the adoption of its children."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from attentionvote.tracking.run import Run
from attentionvote.tracking.run_opening import PARENT_TAG, start_run
from attentionvote.tracking.store import connect, exclusive, experiment_id, resolve_store

log = logging.getLogger(__name__)

GROUP_TAG = "attentionvote.group"  # digest of what the group is


def open_group(store: str | None, experiment: str, name: str, digest: str, **settings: Any) -> Run:
    """Open the run above a group, the same one whenever a group of this digest is opened.

    Args:
        store: see :func:`attentionvote.tracking.store.resolve_store`.
        experiment: where the run lives; the runs below it may live in others.
        name: shown in the UI, of a new run.
        digest: of what makes two calls the same group; kept as a tag.
        settings: handed to :func:`attentionvote.tracking.start_run` (tags, params, config_yaml ...).

    Raises:
        ValueError: the store's URI is impossible.
        ConnectionError: the tracking server does not answer.
    """
    uri = resolve_store(store)
    client = connect(uri)
    group_experiment = experiment_id(client, uri, experiment)
    with exclusive(uri):
        runs = client.search_runs([group_experiment], f"tags.`{GROUP_TAG}` = '{digest}'", max_results=1)
        if runs:
            run_id = runs[0].info.run_id
        else:
            # The first session is counted 0 when start_run opens it.
            tags = {GROUP_TAG: digest, "sessions": "-1"}
            run_id = client.create_run(group_experiment, run_name=name, tags=tags).info.run_id
    return start_run(uri, run_id=run_id, system_interval_s=0, **settings)


def adopt(store: str | None, parent: str, run_id: str, tags: Mapping[str, object]) -> None:
    """Tag a run of a group, and show it below ``parent`` when nothing is above it yet.

    What cannot be stored is said in a warning: bookkeeping never ends the work that it is about.
    """
    try:
        client = connect(resolve_store(store))
        if PARENT_TAG not in client.get_run(run_id).data.tags:
            tags = {**tags, PARENT_TAG: parent}
        for name, value in tags.items():
            client.set_tag(run_id, name, str(value))
    except Exception as error:  # the run is gone, the store is away
        log.warning("run %s could not be put below %s: %s", run_id, parent, str(error).strip().split("\n")[0])
