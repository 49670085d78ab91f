"""The driver ends: Ctrl-C and a script without a main guard, in processes of their own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

pytestmark = pytest.mark.slow
HEAD = "import sys\nfrom pathlib import Path\nfrom execution_tasks import Marked, square\n"
HEAD += "from attentionvote.execution import LocalPool, RayCluster, run_all\n"


def start(folder: Path, text: str, **variables: str) -> subprocess.Popen:
    script = folder / "driver.py"
    script.write_text(HEAD + text)
    fixtures = Path(__file__).resolve().parents[1] / "fixtures"
    environment = {**os.environ, "PYTHONPATH": str(fixtures), "RAY_USAGE_STATS_ENABLED": "0", **variables}
    return subprocess.Popen(
        [sys.executable, script], stderr=subprocess.PIPE, text=True, start_new_session=True, env=environment
    )


LONG = """
if __name__ == "__main__":
    task = Marked(Path({folder!r}), seconds=20.0)
    list(run_all(task, list(range(9)), LocalPool(), workers=2))
"""


def test_ctrl_c_ends_all_workers(tmp_path: Path) -> None:
    driver = start(tmp_path, LONG.format(folder=str(tmp_path)))
    deadline = time.monotonic() + 30
    while len(list(tmp_path.glob("begin-*"))) < 2:
        assert driver.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    workers = psutil.Process(driver.pid).children(recursive=True)
    assert len(workers) >= 2
    began = time.monotonic()
    os.killpg(driver.pid, signal.SIGINT)  # as a terminal does: to every process of the group
    _, err = driver.communicate(timeout=20)
    assert time.monotonic() - began < 10
    assert err.count("KeyboardInterrupt") == 1  # the driver's own
    psutil.wait_procs(workers, timeout=5)
    assert not [process for process in workers if process.is_running() and process.status() != "zombie"]
    assert not list(tmp_path.glob("end-*"))


def test_workers_do_not_outlive_a_killed_driver(tmp_path: Path) -> None:
    driver = start(tmp_path, LONG.format(folder=str(tmp_path)))
    deadline = time.monotonic() + 30
    while len(list(tmp_path.glob("begin-*"))) < 2:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    workers = psutil.Process(driver.pid).children(recursive=True)
    driver.kill()
    driver.communicate()
    psutil.wait_procs(workers, timeout=10)
    assert not [process for process in workers if process.is_running() and process.status() != "zombie"]


def test_workers_that_cannot_start_are_no_endless_loop(tmp_path: Path) -> None:
    driver = start(tmp_path, "list(run_all(square, [1, 2, 3], LocalPool(), workers=2, retries=1))\n")
    _, err = driver.communicate(timeout=60)
    assert driver.returncode == 1
    assert "a worker process died (out of memory? exit code 1) 2 times at job 0 after 0 of 3 jobs" in err


def test_the_package_costs_no_ray_and_no_submitit_until_they_are_used(tmp_path: Path) -> None:
    driver = start(
        tmp_path, "assert not {'ray', 'submitit'} & set(sys.modules)\nassert 'attentionvote' in sys.modules\n"
    )
    assert driver.communicate(timeout=60) == (None, "")


def test_a_cluster_that_is_not_there_is_one_sentence(tmp_path: Path) -> None:
    text = "try:\n    list(run_all(square, [1], RayCluster('auto')))\n"
    text += "except ConnectionError as error:\n    sys.exit(str(error))\n"
    driver = start(tmp_path, text, RAY_AUTH_TOKEN="0" * 32, RAY_TMPDIR=str(tmp_path))
    _, err = driver.communicate(timeout=60)
    assert driver.returncode == 1
    last = err.strip().splitlines()[-1]
    assert last.startswith("the Ray cluster at address=auto cannot be joined (")
    assert last.endswith("start one with `ray start --head`, or set cluster.address=null for one of this machine")
