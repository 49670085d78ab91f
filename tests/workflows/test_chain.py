"""One part of a fleet: the chain of its verbs, the words each is given, and what their processes know."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from attentionvote.execution.job_process import handed_on
from attentionvote.workflows.chain import VERBS, MemberTask

# Stands for every verb: keeps what it was told, and its tracking user.
VERB = """
import json, os, sys
from pathlib import Path
verb = Path(sys.argv[0]).stem
told = {"words": sys.argv[1:], "user": os.environ.get("MLFLOW_TRACKING_USERNAME")}
print(json.dumps({"stage": verb, "run_id": "feed", "bundle": "outputs/export/gear/abc", **told}))
"""


def test_every_verb_gets_its_words_what_came_before_and_the_environment(tmp_path: Path) -> None:
    for verb in VERBS:
        (tmp_path / f"{verb}.py").write_text(VERB, encoding="utf-8")
    words = {"train": ("seed=3",), "export": ("root=d",), "evaluate": ()}
    task = MemberTask(words, tmp_path / "logs", tmp_path, {"MLFLOW_TRACKING_USERNAME": "cell"})
    answers = task("gear")
    assert {verb: answers[verb]["words"] for verb in VERBS} == {
        "train": ["object=gear", "seed=3"],
        "export": ["object=gear", "root=d", "run=feed"],
        "evaluate": ["object=gear", "bundle='abc'"],
    }
    assert {answers[verb]["user"] for verb in VERBS} == {"cell"}
    assert json.dumps(answers).count("cell") == 3
    assert "cell" not in repr(task)  # it may be a password


def test_passwords_of_tracking_and_study_are_handed_on_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("MLFLOW_TRACKING_PASSWORD", "PGPASSWORD", "SECRET_OF_SOMEBODY"):
        monkeypatch.setenv(name, "x")
    known = handed_on()
    assert {"MLFLOW_TRACKING_PASSWORD", "PGPASSWORD"} <= set(known)
    assert "SECRET_OF_SOMEBODY" not in known
