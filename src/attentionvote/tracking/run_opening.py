"""Opening a run, new or again, with a record of where it comes from."""

from __future__ import annotations

import contextlib
import getpass
import json
import logging
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from attentionvote.tracking import provenance
from attentionvote.tracking.datasets import RunDataset
from attentionvote.tracking.run import Run, status_of
from attentionvote.tracking.store import connect, experiment_id, resolve_store, shown

if TYPE_CHECKING:
    from mlflow.entities import Run as MlflowRun

log = logging.getLogger(__name__)
PARENT_TAG = "mlflow.parentRunId"  # what MLflow's pages nest runs by
SESSION_TAG = "git.session_"  # and the session's number: its commit, and the digest of its changes
PATCH = "uncommitted.patch"


def session_folder(session: int) -> str:
    """Where the files of a session lie; what the run began with is never overwritten."""
    return f"resume_{session}/" if session else ""


def start_run(
    store: str | None = None,
    experiment: str = "default",
    name: str | None = None,
    run_id: str | None = None,
    params: Mapping[str, object] | None = None,
    config_yaml: str = "",
    tags: Mapping[str, object] | None = None,
    datasets: Mapping[str, RunDataset] | None = None,
    repository: Path | None = None,
    system_interval_s: float = 15.0,
    parent: str | None = None,
) -> Run:
    """Open a new run, or the run of ``run_id`` again.

    Args:
        store: see :func:`attentionvote.tracking.store.resolve_store`.
        experiment: created when new. A resumed run stays in its own.
        name: shown in the UI.
        run_id: of the run to resume, whatever ended it (kill -9 included); None for a new one.
        params: what identifies the run, by dotted name; immutable, see :meth:`Run.log_params`.
        config_yaml: the full resolved configuration, stored as ``config.yaml``.
        tags: free labels.
        datasets: what it is made with, by use (``train`` ...).
        repository: folder whose git state is recorded; the working directory by default.
        system_interval_s: seconds between samples of the machine's load, 0 for none.
        parent: id of the run that this one is shown below, in the same store; a resumed run that has a parent keeps it.

    Raises:
        ValueError: the store's URI is impossible, or it has no run ``run_id`` or ``parent``.
        ConnectionError: the tracking server does not answer.
    """
    uri = resolve_store(store)
    client = connect(uri)
    from mlflow.exceptions import MlflowException

    def existing_run(argument: str, name: str) -> MlflowRun:
        try:
            return client.get_run(name)
        except MlflowException as error:
            raise ValueError(
                f"{argument} must name a run in {shown(uri)}, got {name!r}, which it does not have"
            ) from error

    below = {} if parent is None else {PARENT_TAG: existing_run("parent", parent).info.run_id}
    if run_id is None:
        in_experiment = experiment_id(client, uri, experiment)
        run_id = client.create_run(in_experiment, run_name=name, tags={"sessions": "0", **below}).info.run_id
        session = 0
    else:
        stored = existing_run("run_id", run_id)
        below = {} if PARENT_TAG in stored.data.tags else below
        if stored.info.lifecycle_stage == "deleted":
            client.restore_run(run_id)
        client.update_run(run_id, status="RUNNING")  # FAILED or KILLED before, or left RUNNING by a kill -9
        session = int(stored.data.tags.get("sessions", "0")) + 1
    run = Run(client, uri, run_id, system_interval_s)
    try:
        _record_origin(run, session, config_yaml, repository or Path.cwd())
        run.log_tags({**(tags or {}), **below, "sessions": session})
        run.log_params(params or {})
        if datasets:
            run.log_datasets(datasets)
    except BaseException as error:
        run.close(status_of(error))
        raise
    return run


def _record_origin(run: Run, session: int, config_yaml: str, repository: Path) -> None:
    git = provenance.git_state(repository)
    run.commit = git.label
    hardware, versions = provenance.hardware(), provenance.package_versions()
    command = provenance.command_line()
    run.log_tags(
        {
            "git.commit": git.commit,
            "git.dirty": str(git.is_dirty).lower(),
            f"{SESSION_TAG}{session}": json.dumps({"commit": git.label, "patch": git.patch_digest}),
            "mlflow.source.git.commit": git.commit,
            "mlflow.source.name": sys.argv[0],
            "mlflow.source.type": "LOCAL",
            **{f"hardware.{key}": hardware[key] for key in ("cpu", "cores", "memory_gib", "gpu")},
            **{f"version.{key}": value for key, value in versions.items()},
        }
    )
    folder = session_folder(session)
    if config_yaml:
        run.log_text(f"{folder}config.yaml", config_yaml)
    environment = {"command": command, "hardware": hardware, "versions": versions, "git_commit": git.commit}
    run.log_text(f"{folder}environment.json", json.dumps(environment, indent=2) + "\n")
    if git.is_dirty:
        if not git.is_whole:
            log.warning(
                "the changes since commit %s are not recorded whole: commit them, or no gate lets it pass",
                git.commit[:12],
            )
        run.log_text(f"{folder}{PATCH}", git.patch)
        run.log_text(f"{folder}uncommitted_status.txt", git.status)
    with contextlib.suppress(OSError, KeyError):  # a container's user may have no name
        user = getpass.getuser()
        run.log_tags({"mlflow.user": user, "user": user})
