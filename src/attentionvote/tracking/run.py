"""A run: logged to, closed with the right status."""

from __future__ import annotations

import atexit
import io
import json
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal

from attentionvote.tracking.artifact_writer import ArtifactWriter
from attentionvote.tracking.datasets import RunDataset, dataset_inputs
from attentionvote.tracking.metric_writer import MetricWriter
from attentionvote.tracking.store import is_server
from attentionvote.tracking.system_metrics import SystemSampler

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from mlflow import MlflowClient

log = logging.getLogger(__name__)

Status = Literal["FINISHED", "FAILED", "KILLED"]
PARAM_LIMIT = 6000  # MLflow's limit for a value
# Tags that MLflow's pages read: the description, and which artefacts are tables.
NOTE_TAG, TABLES_TAG = "mlflow.note.content", "mlflow.loggedArtifacts"


def status_of(error: BaseException | None) -> Status:
    """How a run ended by an exception ends: interrupts and exits on purpose are KILLED, everything else FAILED.

    What an interrupt brings about while it is on its way, such as the end of a loader process, does not count.
    """
    cause = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__context__
    error = cause or error
    if error is None or (isinstance(error, SystemExit) and error.code in (None, 0)):
        return "FINISHED"
    return "KILLED" if isinstance(error, KeyboardInterrupt | SystemExit | GeneratorExit) else "FAILED"


class Run:
    """One MLflow run with batched, asynchronous writers. Made by ``start_run``; also a context manager.

    Writing never raises because of the store: what cannot be written waits and is tried again (one warning).
    A process that ends without ``close`` is recorded as FAILED or KILLED; only ``kill -9`` leaves it RUNNING, until
    it is resumed.
    """

    def __init__(self, client: MlflowClient, uri: str, run_id: str, system_interval_s: float) -> None:
        stored = client.get_run(run_id)
        self.id: str = run_id
        self.store = uri
        self.commit = ""  # of the code that runs, as a model's card names it
        self.experiment_id: str = stored.info.experiment_id
        self.experiment: str = client.get_experiment(self.experiment_id).name
        self.status: str = "RUNNING"
        self._client = client
        self._params: dict[str, str] = dict(stored.data.params)
        self._described = NOTE_TAG in stored.data.tags
        self._tables = [entry["path"] for entry in json.loads(stored.data.tags.get(TABLES_TAG, "[]"))]
        last_steps = {metric.key: metric.step for metric in stored.data.to_proto().metrics}
        self._metrics = MetricWriter(client, run_id, last_steps)
        self._artifacts = ArtifactWriter(client, run_id, stored.info.artifact_uri)
        self._sampler: SystemSampler | None = None
        if system_interval_s > 0:
            first = self._metrics.last_step("system/cpu_percent") + 1
            self._sampler = SystemSampler(self._metrics.add, first, system_interval_s)
        self._pid = os.getpid()
        self._terminated = False
        atexit.register(self._close_at_exit)
        self._catch_sigterm()

    @property
    def url_hint(self) -> str:
        """Where to look at the run: its address on a server, or what to do for a local store."""
        page = f"/#/experiments/{self.experiment_id}/runs/{self.id}"
        return self.store + page if is_server(self.store) else f"make ui, then {page}"

    def log_metrics(self, metrics: Mapping[str, float], step: int) -> None:
        """Queue metrics of one step (microseconds; written within seconds)."""
        if self.status == "RUNNING":
            self._metrics.add(metrics, step)

    def log_params(self, params: Mapping[str, object]) -> None:
        """Log parameters. They are immutable: of a resumed run the first value stays, a change is tagged and warned."""
        from mlflow.entities import Param, RunTag

        texts = {name: str(value)[:PARAM_LIMIT] for name, value in params.items()}
        changed = {k: {"was": self._params[k], "now": v} for k, v in texts.items() if self._params.get(k, v) != v}
        new = {name: value for name, value in texts.items() if name not in self._params}
        tags = []
        if changed:
            log.warning("run %s is resumed with other parameters: %s", self.id, json.dumps(changed))
            tags = [RunTag("resumed_with_other_params", json.dumps(changed)[:PARAM_LIMIT])]
        rows = [Param(name, value) for name, value in new.items()]
        for start in range(0, max(len(rows), 1), 100):  # MLflow's limit for one request
            if self._try(
                "parameters", lambda s=start: self._client.log_batch(self.id, params=rows[s : s + 100], tags=tags)
            ):
                self._params.update({row.key: row.value for row in rows[start : start + 100]})

    def log_tags(self, tags: Mapping[str, object]) -> None:
        """Set tags; the newest value counts."""
        from mlflow.entities import RunTag

        rows = [RunTag(name, str(value)[:PARAM_LIMIT]) for name, value in tags.items()]
        self._try("tags", lambda: self._client.log_batch(self.id, tags=rows))

    def log_text(self, name: str, text: str) -> None:
        """Store a text as artefact ``name``, in place of an older one."""
        self._artifacts.put_bytes(text.encode(), name)

    def log_file(self, name: str, path: str | Path) -> None:
        """Store a copy of a file as artefact ``name``, in place of an older one."""
        self._artifacts.put_file(Path(path), name)

    def log_figure(self, name: str, figure: Figure | bytes, step: int | None = None) -> None:
        """Store a figure (or PNG bytes) as artefact ``name``; with a step, beside the older ones.

        ``val/pr.png`` of step 1200 becomes ``val/pr/step_00001200.png``.
        """
        if not isinstance(figure, bytes):
            buffer = io.BytesIO()
            figure.savefig(buffer, format="png")
            figure = buffer.getvalue()
        if step is not None:
            path = PurePosixPath(name)
            name = str(path.with_suffix("") / f"step_{step:08d}{path.suffix}")
        self._artifacts.put_bytes(figure, name)

    def log_table(self, name: str, rows: Sequence[Mapping[str, object]]) -> None:
        """Store rows as an artefact that MLflow's pages show as a table and ``mlflow.load_table`` reads.

        Args:
            name: of the artefact, ``.json``.
            rows: with the columns of the first.
        """
        columns = list(rows[0]) if rows else []
        table = {"columns": columns, "data": [[row[column] for column in columns] for row in rows]}
        self.log_text(name, json.dumps(table))
        if name not in self._tables:
            self._tables.append(name)
            self.log_tags({TABLES_TAG: json.dumps([{"path": path, "type": "table"} for path in self._tables])})

    def describe(self, text: str) -> None:
        """Give the run a description (Markdown), unless it has one: a person's stays."""
        if not self._described:
            self.log_tags({NOTE_TAG: text})
            self._described = True

    def log_datasets(self, datasets: Mapping[str, RunDataset]) -> None:
        """Record the data by use: full digests as params, and as MLflow's datasets."""
        self.log_params({f"data.{use}": data.digest for use, data in datasets.items()})
        self._try("datasets", lambda: self._client.log_inputs(self.id, dataset_inputs(datasets)))

    def metric_history(self, name: str) -> tuple[list[int], list[float]]:
        """Steps and values of a metric in step order, everything queued included; for figures of the whole run."""
        self._metrics.flush(timeout_s=10.0)
        rows = sorted((row.step, row.timestamp, row.value) for row in self._client.get_metric_history(self.id, name))
        return [row[0] for row in rows], [row[2] for row in rows]

    def download(self, name: str, folder: Path) -> Path:
        """Fetch an artefact into a folder; returns its path."""
        self._artifacts.flush(timeout_s=60.0)
        folder.mkdir(parents=True, exist_ok=True)
        return Path(self._client.download_artifacts(self.id, name, str(folder)))

    def flush(self, timeout_s: float = 10.0) -> bool:
        """Wait until everything queued is stored; False when the store does not manage within the time."""
        start = time.monotonic()
        metrics = self._metrics.flush(timeout_s)
        return self._artifacts.flush(max(0.0, timeout_s - (time.monotonic() - start))) and metrics

    def flush_metrics(self, timeout_s: float = 2.0) -> bool:
        """Wait until the queued metrics are stored: called before a checkpoint counts on them."""
        return self._metrics.flush(timeout_s)

    def close(self, status: Status = "FINISHED") -> None:
        """Store what is left and end the run; a second call does nothing."""
        if self.status != "RUNNING" or os.getpid() != self._pid:
            return
        if self._sampler:
            self._sampler.close()
        self.status = status
        lost_metrics = self._metrics.close(timeout_s=20.0)
        lost_files = self._artifacts.close(timeout_s=20.0)
        if lost_metrics or lost_files:
            what = [f"{lost_metrics} metrics"] * bool(lost_metrics) + lost_files
            log.warning("run %s ends without %s: the tracking store could not take them", self.id, ", ".join(what))
        self._try("status", lambda: self._client.set_terminated(self.id, status))
        atexit.unregister(self._close_at_exit)

    def __enter__(self) -> Run:
        return self

    def __exit__(self, _: type[BaseException] | None, error: BaseException | None, __: TracebackType | None) -> None:
        self.close(status_of(error))

    def _try(self, what: str, write: Any) -> bool:
        try:
            write()
        except Exception as error:  # tracking never ends a training
            log.warning("%s of run %s could not be stored: %s", what, self.id, str(error).strip().split("\n")[0])
            return False
        return True

    def _close_at_exit(self) -> None:
        interrupted = self._terminated or issubclass(getattr(sys, "last_type", None) or Exception, KeyboardInterrupt)
        self.close("KILLED" if interrupted else "FAILED")

    def _catch_sigterm(self) -> None:
        """Turn SIGTERM into SystemExit where nobody handles it: its default would skip every clean-up."""

        def end(number: int, _: object) -> None:
            self._terminated = True
            raise SystemExit(128 + number)

        if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
            signal.signal(signal.SIGTERM, end)
