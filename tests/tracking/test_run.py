"""A run on a real SQLite store: contents, resume, statuses."""

import getpass
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import warm_starter

from attentionvote.tracking.datasets import RunDataset
from attentionvote.tracking.run import status_of
from attentionvote.tracking.run_opening import start_run
from attentionvote.tracking.store import connect

DIGEST = "0123456789abcdef" * 4


@pytest.fixture
def client(store):
    return connect(store)


@pytest.mark.parametrize("store", ["sqlite", "postgresql"], indirect=True)
def test_start_run_records_what_it_was_given_and_where_it_comes_from(store, client, tmp_path):
    run = start_run(
        store, "rod", name="first", params={"lr": 0.001}, config_yaml="lr: 0.001\n", tags={"object": "rod"},
        datasets={"train": RunDataset(DIGEST, "rod/train", Path("/data/rod"), {"scenes": 3})}, system_interval_s=0,
    )  # fmt: skip
    run.log_metrics({"val/ap@10": 0.5, "train/loss/vote": np.float32(2)}, 7)
    run.log_text("notes/a.txt", "hello")
    assert run.download("notes/a.txt", tmp_path).read_text() == "hello"
    assert run.download("config.yaml", tmp_path).read_text() == "lr: 0.001\n"
    environment = json.loads(run.download("environment.json", tmp_path).read_text())
    run.close()
    stored = client.get_run(run.id)
    assert stored.info.status == "FINISHED"
    assert stored.info.run_name == "first"
    assert stored.data.params == {"lr": "0.001", "data.train": DIGEST}
    assert stored.data.metrics == {"val/ap_10": 0.5, "train/loss/vote": 2.0}
    (data,) = [entry.dataset for entry in stored.inputs.dataset_inputs]
    assert (data.name, data.digest) == ("rod/train", DIGEST[:32])
    assert json.loads(data.source) == {"uri": "/data/rod", "digest": DIGEST}
    assert json.loads(data.profile) == {"scenes": 3, "digest": DIGEST}
    assert stored.data.tags["user"] == stored.data.tags["mlflow.user"] == getpass.getuser()
    assert stored.data.tags["object"] == "rod"
    assert stored.data.tags["version.torch"] == environment["versions"]["torch"]
    assert int(stored.data.tags["hardware.cores"]) >= 1
    assert run.url_hint.startswith("make ui")


def test_logging_costs_less_than_a_millisecond_a_step(run):
    values = {f"train/loss/term_{index}": 0.1 * index for index in range(12)}
    start = time.process_time()
    for step in range(200):
        run.log_metrics(values, step)
    assert (time.process_time() - start) / 200 < 1e-3
    assert run.metric_history("train/loss/term_3") == (list(range(200)), [pytest.approx(0.3)] * 200)


@pytest.mark.parametrize("store", ["sqlite", "postgresql"], indirect=True)
def test_resume_keeps_parameters_repairs_status_and_continues_series(store, client, caplog, tmp_path):
    run = start_run(store, "rod", params={"lr": 1}, config_yaml="a: 1", system_interval_s=0)
    run.log_metrics({"train/loss": 5.0}, 1)
    run.log_metrics({"train/loss": 4.0}, 2)
    run.close("FAILED")
    assert client.get_run(run.id).info.status == "FAILED"
    again = start_run(store, "rod", run_id=run.id, params={"lr": 2, "new": 3}, config_yaml="a: 2", system_interval_s=0)
    assert client.get_run(run.id).info.status == "RUNNING"
    for step in (2, 3):  # step 2 is repeated, as after a checkpoint of step 1
        again.log_metrics({"train/loss": 9.0 - step, "test/ap_10": 0.1 * step}, step)
    assert again.metric_history("train/loss") == ([1, 2, 3], [5.0, 4.0, 6.0])
    assert again.download("config.yaml", tmp_path).read_text() == "a: 1"
    assert again.download("resume_1/config.yaml", tmp_path / "new").read_text() == "a: 2"
    again.close()
    stored = client.get_run(run.id)
    assert stored.info.status == "FINISHED"
    assert stored.data.params == {"lr": "1", "new": "3"}
    assert json.loads(stored.data.tags["resumed_with_other_params"]) == {"lr": {"was": "1", "now": "2"}}
    assert stored.data.tags["sessions"] == "1"
    assert "resumed with other parameters" in caplog.text


def test_a_table_is_one_and_a_person_s_description_stays(store, client):
    import mlflow

    run = start_run(store, "rod", system_interval_s=0)
    for value in (1.0, 2.0):  # the newest counts
        run.log_table("test/a.json", [{"figure": "ap", "value": value}, {"figure": "n", "value": 3}])
    run.log_table("test/b.json", [])
    run.describe("ours")
    run.close()
    client.set_tag(run.id, "mlflow.note.content", "theirs")
    again = start_run(store, "rod", run_id=run.id, system_interval_s=0)
    again.describe("ours")
    again.log_table("test/b.json", [])
    again.close()
    tags = client.get_run(run.id).data.tags
    assert tags["mlflow.note.content"] == "theirs"
    assert [entry["path"] for entry in json.loads(tags["mlflow.loggedArtifacts"])] == ["test/a.json", "test/b.json"]
    mlflow.set_tracking_uri(store)
    try:
        table = client.load_table(run.experiment_id, "test/a.json", [run.id])
    finally:
        mlflow.set_tracking_uri(None)
        os.environ.pop("MLFLOW_TRACKING_URI", None)
    assert table.to_dict("list") == {"figure": ["ap", "n"], "value": [2.0, 3.0]}


def test_resume_of_an_unknown_run_is_one_sentence(store):
    with pytest.raises(ValueError, match=r"run_id must name a run in sqlite.*got 'nothing'"):
        start_run(store, "rod", run_id="nothing")


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (None, "FINISHED"),
        (SystemExit(0), "FINISHED"),
        (ValueError("x"), "FAILED"),
        (KeyboardInterrupt(), "KILLED"),
        (SystemExit(143), "KILLED"),
    ],
)
def test_status_of(error, status):
    assert status_of(error) == status


def test_what_an_interrupt_brings_about_is_the_interrupt():
    error = RuntimeError("DataLoader worker is killed by signal: Terminated.")
    error.__context__ = SystemExit(1)
    assert status_of(error) == "FAILED"
    error.__context__.__context__ = KeyboardInterrupt()
    assert status_of(error) == "KILLED"


def test_leaving_the_block_by_an_exception_ends_the_run_as_failed(store, client):
    with pytest.raises(RuntimeError), start_run(store, "rod", system_interval_s=0) as run:  # noqa: PT012
        run.log_metrics({"x": 1.0}, 0)
        raise RuntimeError
    assert client.get_run(run.id).info.status == "FAILED"
    assert client.get_run(run.id).data.metrics == {"x": 1.0}


@pytest.mark.slow
@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, "KILLED"), (signal.SIGKILL, "RUNNING")])
def test_killed_process_leaves_a_run_that_says_so_and_can_be_resumed(store, client, number, status):
    code = (
        "import sys, time; from attentionvote.tracking.run_opening import start_run\n"
        "run = start_run(sys.argv[1], 'rod', system_interval_s=0); run.log_metrics({'x': 1}, 0); run.flush()\n"
        "print(run.id, flush=True); time.sleep(60)"
    )
    command = [sys.executable, "-c", code, store]
    with warm_starter.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ}) as process:
        assert process.stdout is not None
        run_id = process.stdout.readline().strip()
        process.send_signal(number)
        process.wait(timeout=60)
    assert client.get_run(run_id).info.status == status
    with start_run(store, "rod", run_id=run_id, system_interval_s=0) as run:
        run.log_metrics({"x": 2.0}, 1)
    assert client.get_run(run_id).info.status == "FINISHED"
    assert [row.value for row in client.get_metric_history(run_id, "x")] == [1.0, 2.0]


def test_system_metrics_are_sampled_and_their_steps_go_on_after_a_resume(store, client):
    run = start_run(store, "rod", system_interval_s=0.05)
    deadline = time.monotonic() + 20
    while len(run.metric_history("system/cpu_percent")[0]) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    run.close()
    first = client.get_metric_history(run.id, "system/process_memory_gib")
    assert all(0.01 < row.value < 100 for row in first)
    again = start_run(store, "rod", run_id=run.id, system_interval_s=0.05)
    while len(again.metric_history("system/cpu_percent")[0]) <= len(first) and time.monotonic() < deadline:
        time.sleep(0.05)
    steps = again.metric_history("system/cpu_percent")[0]
    again.close()
    assert steps == list(range(len(steps)))
    assert len(steps) > len(first)


def test_figure_names_with_a_step_stand_beside_each_other(run, tmp_path):
    for step in (1, 20):
        run.log_figure("val/pr.png", b"png", step)
    run.log_figure("val/pr.png", b"latest")
    assert run.download("val/pr.png", tmp_path).read_bytes() == b"latest"
    names = sorted(path.name for path in run.download("val/pr", tmp_path / "all").iterdir())
    assert names == ["step_00000001.png", "step_00000020.png"]


@pytest.mark.parametrize("store", ["sqlite", "postgresql"], indirect=True)
def test_a_run_below_another_one_keeps_its_parent(store, client):
    above, other = (start_run(store, "grids", name=name, system_interval_s=0) for name in ("above", "other"))
    below = start_run(store, "rod", system_interval_s=0, parent=above.id)
    below.close()
    start_run(store, "rod", run_id=below.id, system_interval_s=0, parent=other.id).close()
    assert client.get_run(below.id).data.tags["mlflow.parentRunId"] == above.id
    alone = start_run(store, "rod", system_interval_s=0)
    alone.close()
    start_run(store, "rod", run_id=alone.id, system_interval_s=0, parent=other.id).close()
    assert client.get_run(alone.id).data.tags["mlflow.parentRunId"] == other.id
    with pytest.raises(ValueError, match=r"parent must name a run in (sqlite|postgresql).*got 'nobody'"):
        start_run(store, "rod", parent="nobody", system_interval_s=0)
    for run in (above, other):
        run.close()
