"""Real Lightning trainings through the logger: checkpoints of several callbacks, failures, kill -9 and resume."""

import json
import os
import runpy
import subprocess
import sys
import warnings
from argparse import Namespace
from pathlib import Path
from types import SimpleNamespace

import pytest
import warm_starter

from attentionvote.tracking.lightning_logger import RunLogger
from attentionvote.tracking.run_opening import start_run
from attentionvote.tracking.store import connect

SCRIPT = Path(__file__).with_name("fit_script.py")


def _checkpoint(folder, key, monitor, best, last="", score=None):
    paths = {name: str(folder / name) if name else "" for name in (best, last)}
    return SimpleNamespace(
        state_key=key, monitor=monitor, mode="max", best_model_score=score,
        best_model_path=paths[best], last_model_path=paths[last],
    )  # fmt: skip


@pytest.fixture
def logger(run):
    return RunLogger(run)


def _stored(logger, folder):
    assert logger.run.flush()
    found = logger.run.download("checkpoints", folder)
    return {path.name: path.read_text() for path in found.iterdir()}


def test_best_of_every_callback_and_the_newest_are_kept(logger, tmp_path):
    for name in ("a", "b", "c"):
        (tmp_path / name).write_text(name)
    os.symlink(tmp_path / "c", tmp_path / "last")
    ap = _checkpoint(tmp_path, "ap", "val/ap_10", "a", score=0.5)
    logger.after_save_checkpoint(ap)
    logger.after_save_checkpoint(_checkpoint(tmp_path, "loss", "val/loss", "b", "last", score=2))
    stored = _stored(logger, tmp_path / "first")
    index = json.loads(stored.pop("index.json"))
    assert stored == {"best_val_ap_10.ckpt": "a", "best_val_loss.ckpt": "b", "last.ckpt": "c"}
    assert index["best_val_ap_10.ckpt"] == {
        "file": "a", "bytes": 1, "monitor": "val/ap_10", "mode": "max", "score": 0.5
    }  # fmt: skip
    (tmp_path / "d").write_text("dd")
    logger.after_save_checkpoint(_checkpoint(tmp_path, "ap", "val/ap_10", "d", score=0.7))
    stored = _stored(logger, tmp_path / "second")
    assert json.loads(stored.pop("index.json"))["best_val_ap_10.ckpt"]["score"] == 0.7
    assert stored == {"best_val_ap_10.ckpt": "dd", "best_val_loss.ckpt": "b", "last.ckpt": "c"}


def test_callbacks_of_one_metric_and_of_none_do_not_overwrite_each_other(logger, tmp_path):
    for name in ("a", "b", "c"):
        (tmp_path / name).write_text(name)
    logger.after_save_checkpoint(_checkpoint(tmp_path, "max", "val/ap_10", "a"))
    logger.after_save_checkpoint(_checkpoint(tmp_path, "rare", "val/ap_10", "b"))
    logger.after_save_checkpoint(_checkpoint(tmp_path, "every", None, "c"))
    stored = _stored(logger, tmp_path / "out")
    del stored["index.json"]
    assert stored == {"best_val_ap_10.ckpt": "a", "best_val_ap_10-2.ckpt": "b", "last.ckpt": "c"}


def test_hyperparameters_may_come_twice_and_metrics_of_validation_are_stored_at_once(logger, store):
    logger.log_hyperparams({"width": 64})
    logger.log_hyperparams(Namespace(width=64, depth=2))
    logger.log_metrics({"train/loss": 1.0}, 0)
    logger.log_metrics({"val/ap_10": 0.5}, 1)
    data = connect(store).get_run(logger.version).data
    assert data.params == {"width": "64", "depth": "2"}
    assert data.metrics == {"train/loss": 1.0, "val/ap_10": 0.5}
    assert logger.name == "rod"


@pytest.mark.parametrize(("error", "status"), [(RuntimeError("x"), "FAILED"), (KeyboardInterrupt(), "KILLED")])
def test_exception_in_training_ends_the_run(store, error, status):
    run = start_run(store, "rod", system_interval_s=0)
    logger = RunLogger(run)
    try:
        raise error
    except BaseException:
        logger.finalize("failed")  # as Lightning does, while it handles the exception
    assert connect(store).get_run(run.id).info.status == status


def test_end_of_fit_does_not_end_the_run(store, logger):
    logger.finalize("success")
    assert connect(store).get_run(logger.version).info.status == "RUNNING"


@pytest.mark.slow
def test_training_killed_and_started_again_is_one_run_with_contiguous_metrics(store, tmp_path):
    command = [sys.executable, str(SCRIPT), store, "-", str(tmp_path / "ckpt"), "1000"]
    with warm_starter.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        run_id = process.stdout.readline().strip()
        while process.stdout.readline().strip() not in ("5", ""):
            pass
        process.kill()
    client = connect(store)
    assert client.get_run(run_id).info.status == "RUNNING"
    with warnings.catch_warnings():  # of Lightning and torch, about a loader without workers
        warnings.simplefilter("ignore")
        runpy.run_path(str(SCRIPT))["main"](store, run_id, tmp_path / "ckpt", 9)  # this process has all the imports
    runs = client.search_runs([client.get_run(run_id).info.experiment_id])
    assert [(r.info.run_id, r.info.status) for r in runs] == [(run_id, "FINISHED")]
    for name, count in {"train/loss": 9 * 20, "val/loss": 9, "val/ap_10": 9}.items():
        steps = [row.step for row in client.get_metric_history(run_id, name)]
        assert len(steps) == len(set(steps)) == count, (name, steps)
    resumed = start_run(store, run_id=run_id, system_interval_s=0)
    stored = resumed.download("checkpoints", tmp_path / "out")
    resumed.close()
    assert {path.name for path in stored.iterdir()} == {
        "best_val_ap_10.ckpt", "best_val_loss.ckpt", "last.ckpt", "index.json"
    }  # fmt: skip
    import torch

    last = torch.load(stored / "last.ckpt", weights_only=False)
    best = torch.load(stored / "best_val_ap_10.ckpt", weights_only=False)
    assert (last["epoch"], best["epoch"]) == (8, 3)
