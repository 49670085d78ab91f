"""From the verbs to a running cell and back: promote, serve, promote, roll back; then the registry dies."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import promote
import pytest
import rollback

from attentionvote.command.configuration import compose
from attentionvote.inference.client.pose_client import PoseClient
from attentionvote.tracking.run_opening import start_run
from attentionvote.tracking.server import serve
from attentionvote.workflows.settings import PromoteSettings, RollbackSettings


@contextlib.contextmanager
def cell(registry: str, folder: Path) -> Iterator[str]:
    """A cell's server that follows the brick's champion; its address, once it is ready."""
    command = [sys.executable, "-m", "attentionvote.inference.command_line", "serve"]
    command += ["models:/attentionvote-brick@champion", "--registry", registry, "--registry-poll-s", "0.3"]
    command += ["--poll-s", "0.1", "--port", "0", "--state", str(folder / "state")]
    with (folder / "cell.log").open("a") as log:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, env=dict(os.environ))
    assert process.stdout is not None
    try:
        url = json.loads(process.stdout.readline())["url"]
        until = time.monotonic() + 60
        while True:
            with contextlib.suppress(urllib.error.HTTPError), urllib.request.urlopen(f"{url}/v2/health/ready"):
                break
            assert time.monotonic() < until, (folder / "cell.log").read_text()
            time.sleep(0.05)
        yield url
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(timeout=20)
        process.stdout.close()


class Customer:
    """A robot that never stops asking, and remembers every answer's model and every failure."""

    def __init__(self, url: str, cloud) -> None:
        self.models: list[str] = []
        self.failures: list[Exception] = []
        self._stop = threading.Event()
        self._url, self._cloud = url, cloud
        self._thread = threading.Thread(target=self._ask)

    def __enter__(self) -> Customer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def wait_for(self, digest: str, patience_s: float = 60.0) -> None:
        """Until an answer is of this bundle."""
        until = time.monotonic() + patience_s
        while self.models[-1:] != [digest[:12]]:
            assert not self.failures
            assert time.monotonic() < until, f"waited in vain for {digest[:12]}, got {self.models[-1:]}"
            time.sleep(0.02)

    def _ask(self) -> None:
        with PoseClient(self._url, part="brick") as client:
            while not self._stop.is_set():
                try:
                    self.models.append(client.estimate(self._cloud, deadline_ms=5000).version)
                except Exception as error:
                    self.failures.append(error)


@pytest.mark.slow
def test_a_running_cell_follows_promotion_and_rollback_and_outlives_the_registry(
    export_brick, make_cloud, few_scenes, easy_gates, work_tree, put_tables, tmp_path
):
    local = put_tables(tmp_path / "registry" / "mlflow.db")
    with serve(local) as server:

        def made_by_a_training(name: str):
            with start_run(server.url, "brick", config_yaml="a: 1", repository=work_tree, system_interval_s=0) as run:
                pass
            return export_brick(name, run.id, run.commit)

        def promoted():
            return promote.run(compose(PromoteSettings, [*few_scenes, *easy_gates, f"tracking.store={server.url}"]))

        first = made_by_a_training("one")
        assert promoted()["version"] == 1
        with cell(server.url, tmp_path) as url, Customer(url, make_cloud()) as customer:
            customer.wait_for(first.digest)
            second = made_by_a_training("two")
            assert promoted()["champion"] == 2
            customer.wait_for(second.digest)
            back = rollback.run(compose(RollbackSettings, ["object=brick", f"tracking.store={server.url}"]))
            assert back["champion"] == 1
            customer.wait_for(first.digest)
            os.killpg(server.process.pid, signal.SIGKILL)
            answered = len(customer.models)
            while len(customer.models) < answered + 20:
                time.sleep(0.02)
        assert customer.failures == []
        changes = [model for i, model in enumerate(customer.models) if i == 0 or customer.models[i - 1] != model]
        assert changes == [first.digest[:12], second.digest[:12], first.digest[:12]]
        # The registry is dead: a cell that starts now starts from what served well.
        with cell(server.url, tmp_path) as url, Customer(url, make_cloud()) as customer:
            customer.wait_for(first.digest)
