"""Members of a fleet on a real Ray cluster, with stand-ins for the verbs: their chain, a dead worker, a failure."""

from __future__ import annotations

import json
import subprocess
import sys
import uuid
from pathlib import Path

import pytest

# Stands for every verb: notes its words, ends its worker at the first training of the gear, fails at the rod's export.
VERB = """
import json, os, signal, sys, time
from pathlib import Path
from attentionvote.execution.job_process import join_starter, report_failure
starter = os.getppid()
join_starter()
verb, part, notes = Path(sys.argv[0]).stem, sys.argv[1].partition("=")[2], Path(sys.argv[0]).parent / "notes"
first = not notes.exists() or f"{verb} {part}" not in notes.read_text()
with notes.open("a") as file: file.write(f"{verb} {part} {' '.join(sys.argv[2:])}\\n")
print("at work", file=sys.stderr)
if (verb, part) == ("train", "gear") and first: os.kill(starter, signal.SIGKILL); time.sleep(60)
if (verb, part) == ("export", "rod"): report_failure("no disk"); sys.exit(1)
print(json.dumps({"stage": verb, "run_id": f"run-of-{part}", "bundle": f"outputs/export/{part}/abc"}))
"""
FLEET = """
import json, sys
from pathlib import Path
from attentionvote.workflows.fleet.job import _run
from attentionvote.workflows.chain import MemberTask
from attentionvote.execution import RayCluster
folder = Path(sys.argv[1])
task = MemberTask({"train": ("seed=3",), "export": ("root=d",), "evaluate": ()}, folder / "logs", folder)
print(json.dumps(_run(task, ["gear", "rod"], RayCluster(), 2, 1, 1)))
"""


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_members_on_ray_are_chains_of_verbs_and_a_dead_worker_costs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_AUTH_TOKEN", uuid.uuid4().hex)  # else one is written at home
    for verb in ("train", "export", "evaluate"):
        (tmp_path / f"{verb}.py").write_text(VERB, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-c", FLEET, str(tmp_path)], capture_output=True, text=True, timeout=500, check=False
    )
    assert done.returncode == 0, done.stderr
    answers = json.loads(done.stdout.splitlines()[-1])
    assert answers["gear"]["evaluate"]["run_id"] == "run-of-gear"
    assert (answers["rod"]["failed"], answers["rod"]["sentence"]) == ("export", "no disk")
    assert sorted(line.strip() for line in (tmp_path / "notes").read_text().splitlines()) == [
        "evaluate gear bundle='abc'", "export gear root=d run=run-of-gear", "export rod root=d run=run-of-rod",
        "train gear seed=3", "train gear seed=3", "train rod seed=3",
    ]  # fmt: skip
    assert "at work" in (tmp_path / "logs" / "gear-evaluate.log").read_text()
