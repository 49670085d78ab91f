"""Lightning's view of a run."""

from __future__ import annotations

import contextlib
import json
import os
import re
import sys
from argparse import Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lightning.pytorch.loggers.logger import Logger
from lightning.pytorch.utilities import rank_zero_only

from attentionvote.tracking.run import Run, status_of

if TYPE_CHECKING:
    from lightning.pytorch.callbacks import ModelCheckpoint


class RunLogger(Logger):
    """Hands Lightning's metrics, hyper-parameters and checkpoints to a run.

    Every ``ModelCheckpoint`` is served, however many there are: the best of each monitored metric is
    ``checkpoints/best_<metric>.ckpt`` (``/`` becomes ``_``), the newest is ``checkpoints/last.ckpt``, and
    ``checkpoints/index.json`` says which metric and score they have. A newer one replaces the older.

    The end of ``fit`` or ``test`` does not end the run, an exception does; success is the caller's to say
    (``run.close()``), because more follows the training.
    """

    def __init__(self, run: Run) -> None:
        super().__init__()
        self.run = run
        self._callbacks: dict[str, ModelCheckpoint] = {}  # weak proxies, by state key
        self._names: dict[str, str] = {}  # artefact name of a callback's best
        self._stored: dict[str, tuple[object, ...]] = {}  # artefact name -> identity of the file last stored
        self._index: dict[str, dict[str, object]] = {}

    @property
    def name(self) -> str:
        return self.run.experiment

    @property
    def version(self) -> str:
        return self.run.id

    @property
    def experiment(self) -> Run:
        """The run, for modules that log figures."""
        return self.run

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        self.run.log_metrics(metrics, step or 0)
        # Lightning hands these over just before it saves a checkpoint. A kill -9 after the save must find them
        # stored, or the resumed run's curves would have a gap.
        if any(name.startswith("val/") for name in metrics):
            self.run.flush_metrics()

    @rank_zero_only
    def log_hyperparams(self, params: Mapping[str, Any] | Namespace, *_: Any, **__: Any) -> None:
        self.run.log_params(vars(params) if isinstance(params, Namespace) else params)

    @rank_zero_only
    def after_save_checkpoint(self, checkpoint_callback: ModelCheckpoint) -> None:
        self.run.flush_metrics()
        self._callbacks[checkpoint_callback.state_key] = checkpoint_callback
        self._store_checkpoints(checkpoint_callback)

    @rank_zero_only
    def finalize(self, status: str) -> None:
        for callback in self._callbacks.values():
            with contextlib.suppress(ReferenceError):  # the callback is gone, and with it its news
                self._store_checkpoints(callback)
        if status == "failed":
            error = sys.exc_info()[1]
            self.run.close(status_of(error) if error is not None else "FAILED")
        else:
            self.run.flush()

    def _store_checkpoints(self, callback: ModelCheckpoint) -> None:
        if callback.monitor:
            name = self._best_name(callback)
            score = callback.best_model_score
            about = {"monitor": callback.monitor, "mode": callback.mode}
            self._store(name, callback.best_model_path, about | {"score": None if score is None else float(score)})
            last = callback.last_model_path
        else:
            last = callback.last_model_path or callback.best_model_path
        self._store("checkpoints/last.ckpt", last, {})

    def _best_name(self, callback: ModelCheckpoint) -> str:
        key = callback.state_key
        if key not in self._names:
            stem = "checkpoints/best_" + re.sub(r"[^\w\-.]", "_", callback.monitor or "")
            taken = list(self._names.values())
            suffixes = ["", *(f"-{count}" for count in range(2, len(taken) + 2))]  # same metric, other mode or period
            self._names[key] = next(f"{stem}{s}.ckpt" for s in suffixes if f"{stem}{s}.ckpt" not in taken)
        return self._names[key]

    def _store(self, name: str, path: str, about: dict[str, object]) -> None:
        source = Path(os.path.realpath(path)) if path else None  # `last` may be a link
        if source is None or not source.is_file():
            return
        state = source.stat()
        identity = (source, state.st_mtime_ns, state.st_size)
        if self._stored.get(name) == identity:
            return
        self.run.log_file(name, source)
        self._stored[name] = identity
        self._index[Path(name).name] = {"file": source.name, "bytes": state.st_size, **about}
        self.run.log_text("checkpoints/index.json", json.dumps(self._index, indent=2, sort_keys=True) + "\n")
