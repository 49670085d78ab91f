"""A real MLflow server on the loopback interface: what `make ui` starts, and what a team logs to."""

import json
import os
import signal
import subprocess
import sys
import urllib.request

import pytest

from attentionvote import tracking
from attentionvote.tracking.server import serve
from attentionvote.tracking.store import connect


@pytest.mark.slow
def test_run_on_a_server_with_artefacts_an_outage_and_a_resume(tmp_path, caplog, capfd):
    store = f"sqlite:///{tmp_path}/mlflow.db"
    checkpoint = tmp_path / "last.ckpt"
    checkpoint.write_bytes(b"weights" * 1000)
    with serve(store) as server:
        port = int(server.url.rsplit(":", 1)[1])
        run = tracking.start_run(server.url, "rod", params={"lr": 1}, config_yaml="lr: 1", system_interval_s=0)
        run.log_metrics({"train/loss": 1.0}, 0)
        run.log_file("checkpoints/last.ckpt", checkpoint)
        assert run.flush(60)
        assert run.download("checkpoints/last.ckpt", tmp_path / "out").read_bytes() == checkpoint.read_bytes()
        assert run.url_hint == f"{server.url}/#/experiments/{run.experiment_id}/runs/{run.id}"
        assert b"MLflow" in urllib.request.urlopen(server.url, timeout=10).read()
    # The server is away: training goes on, with one warning of each kind.
    run.log_metrics({"train/loss": 2.0}, 1)
    checkpoint.write_bytes(b"newer")
    run.log_file("checkpoints/last.ckpt", checkpoint)
    assert not run.flush(8)
    assert caplog.text.count("metrics wait in memory") == 1
    with serve(store, port):
        assert run.flush(60)
        assert run.metric_history("train/loss") == ([0, 1], [1.0, 2.0])
        assert run.download("checkpoints/last.ckpt", tmp_path / "new").read_bytes() == b"newer"
        run.close("FAILED")
        with tracking.start_run(server.url, run_id=run.id, params={"lr": 1}, system_interval_s=0) as again:
            again.log_metrics({"train/loss": 3.0}, 2)
    stored = connect(store).get_run(run.id)
    assert stored.info.status == "FINISHED"
    assert stored.data.metrics == {"train/loss": 3.0}
    assert capfd.readouterr().out == ""  # MLflow likes to print addresses where a verb prints its result


def test_serve_refuses_a_server():
    with (
        pytest.raises(ValueError, match="only a local store needs a server, got http://tracking:5000"),
        serve("http://tracking:5000"),
    ):
        pass


@pytest.mark.slow
def test_ui_prints_one_json_line_and_ends_on_interrupt(repository, tmp_path):
    store = f"sqlite:///{tmp_path}/mlflow.db"
    command = [sys.executable, str(repository / "pipelines/ui.py"), "--store", store]
    environment = {name: value for name, value in os.environ.items() if name != "MLFLOW_TRACKING_URI"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment) as ui:
        assert ui.stdout is not None
        answer = json.loads(ui.stdout.readline())
        assert answer["store"] == store
        with urllib.request.urlopen(answer["url"] + "/health", timeout=10) as reply:
            assert reply.read() == b"OK"
        ui.send_signal(signal.SIGINT)
        rest, _ = ui.communicate(timeout=30)
    assert ui.returncode == 0
    assert rest == ""
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(answer["url"] + "/health", timeout=5)


def test_ui_rejects_an_impossible_store_in_one_sentence(repository):
    command = [sys.executable, str(repository / "pipelines/ui.py"), "--store", "file:./mlruns"]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 2
    assert result.stdout == ""
    assert len(result.stderr.strip().splitlines()) == 1
    assert "sqlite:///outputs/mlflow.db" in result.stderr
