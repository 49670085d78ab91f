"""The verb benchmark: real trainings' places, real evaluations and the real baseline on tiny scenes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import warm_starter

from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.files import write_json
from attentionvote.inference import load_bundle
from attentionvote.workflows.evaluate.settings import EvaluateSettings
from attentionvote.workflows.export import ExportJob
from attentionvote.workflows.settings import ExportSettings
from attentionvote.workflows.tables import job as benchmark
from attentionvote.workflows.tables.settings import TablesSettings
from attentionvote.workflows.train.job import find_training
from attentionvote.workflows.train.settings import TrainSettings

ROOT = Path(__file__).resolve().parents[3]
# Two cycles of a scene with a few bricks.
FEW = ["evaluation.cycles=2", "evaluation.density=2000", "evaluate=['simulation=smoke','simulation.drop_counts=[2,3]']"]
COARSE = [
    "baseline_workers=1",
    "ppf.sampling=0.15",
    "fpfh.sampling=0.1",
    "+fpfh.feature_radius=0.3",
    "+fpfh.iterations=200",
]
PLACES = ["outputs=outputs/train", "root=data", "tracking.store=mlflow.db", "page=page.md"]


def run(tmp_path: Path, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """The verb in a process of its own."""
    command = [sys.executable, ROOT / "pipelines" / "benchmark.py", *PLACES, *FEW, *words]
    return warm_starter.run(
        command, capture_output=True, text=True, timeout=280, check=False, cwd=tmp_path, env=os.environ | environment
    )


@pytest.mark.slow
def test_ours_and_the_baseline_are_measured_on_the_same_scenes(export_brick: Any, tmp_path: Path) -> None:
    """The brick is trained and exported; two rows want another training, which nobody has made."""
    bundle = export_brick("model", "feed" * 8)
    trained = find_training(
        compose(TrainSettings, ["object=brick", "experiment=smoke", "outputs=outputs/train"])
    ).directory
    trained.mkdir(parents=True)
    (trained / "model.ckpt").write_bytes(b"weights")
    facts = {"run_id": "feed" * 8, "steps": 8, "train_seconds": 60.0, "commit": "c" * 40}
    write_json(trained / "result.json", {"stage": "train", "object": "brick", **facts})
    (tmp_path / "outputs" / "benchmark").mkdir()
    (tmp_path / "outputs" / "export").rename(tmp_path / "outputs" / "benchmark" / "export")
    exported = ["object=brick", "scenes=32", "outputs=outputs/benchmark/export"]
    bundle = load_bundle((tmp_path / "outputs" / "benchmark" / "export" / "brick" / "latest").resolve(), None)
    ExportJob.find(compose(ExportSettings, exported)).finish(bundle, {})
    smoke = ["experiment=smoke", "force=false", "export=['scenes=32']"]
    done = run(
        tmp_path, "table=table_5", "objects=brick", *smoke, "rows='ours,VoteNet-style,PPF,FPFH and ICP'", *COARSE
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    ours, ppf, fpfh = result["cells"]
    rows = [("ours", "brick"), ("PPF", "brick"), ("FPFH and ICP", "brick")]
    assert [(cell["row"], cell["object"]) for cell in (ours, ppf, fpfh)] == rows
    assert ours["evaluation_set"] == ppf["evaluation_set"] == fpfh["evaluation_set"]
    assert ours["bundle"] == bundle.digest
    assert (ours["seed"], ours["commit"], ours["budget"]["steps"]) == (0, "c" * 40, 8)
    assert ppf["budget"] is fpfh["budget"] is None
    for cell in (ours, ppf, fpfh):
        assert cell["scenes"] == 2
        assert cell["figures"]["latency_p50_ms"] > 0
        assert len(cell["thresholds"]) == len(cell["ap_by_threshold"]) == 21
    assert "VoteNet-style, brick: not run (train=true trains it)" in done.stderr
    page = (tmp_path / "page.md").read_text()
    assert "| paper: AttentionVote, AP at 10 % D | 0.967 | 0.992 | 0.996 | 1.000 | 0.989 |" in page
    assert f"| **ours**, AP at 10 % D | {ours['figures']['ap_10']:.3f} | not run | not run | not run |  |" in page
    assert "| VoteNet-style, AP at 2 % D | not run | not run | not run | not run |  |" in page
    assert not (tmp_path / "outputs" / "export").exists()  # nobody's newest model
    # Another call for another object leaves these cells, and measures nothing anew.
    again = run(tmp_path, "table=table_5", "objects=pepper", *smoke, "rows=ours")
    assert again.returncode == 0, again.stderr
    assert json.loads(again.stdout)["cells"] == result["cells"]
    assert (tmp_path / "page.md").read_text() == page


def test_an_object_without_a_mesh_is_left_out_unless_it_is_asked_for(tmp_path: Path) -> None:
    words = ["table=table_7", "experiment=smoke", "rows=slerp"]
    env = {"ATTENTIONVOTE_DATA": str(tmp_path)}
    done = run(tmp_path, *words, **env)
    assert done.returncode == 0, done.stderr
    assert list(json.loads(done.stdout)["left_out"]) == ["slerp, bunny", "slerp, tless_20"]
    assert "| slerp, AP at 10 % D | not run | not run |  |" in (tmp_path / "page.md").read_text()
    done = run(tmp_path, *words, "objects=bunny", **env)
    assert done.returncode == 1
    assert "benchmark: 1 cells could not be measured (first: slerp, bunny: " in done.stderr
    assert "Traceback" not in done.stderr


def test_words_of_trainings_and_of_scenes_are_told_apart() -> None:
    words = [
        "experiment=compact",
        "table=table_6",
        "evaluation.cycles=2",
        "trainer.max_epochs=12",
        "rows=ours",
        "fpfh.sampling=0.1",
    ]
    assert benchmark.training_words(words, True) == ["experiment=compact", "trainer.max_epochs=12"]
    assert benchmark.training_words(["force=true", "seed=1"], False) == ["force=true", "seed=1", "force=false"]
    assert benchmark.scene_words(words) == ["evaluation=benchmark", "evaluation.cycles=2"]
    assert benchmark.scene_words(["evaluation=default"]) == ["evaluation=default"]
    with pytest.raises(ConfigurationError, match="a benchmark takes objects=NAME,NAME, got object="):
        benchmark.training_words(["object=gear"], False)
    assert benchmark.words_of(("object",), ["object.mesh=gear.stl", "objects=gear"]) == ["object.mesh=gear.stl"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["rows=theirs"],
            "benchmark: rows must be among those of table_6, ours, ours (one network), VoteNet-style, PPF, PPF and ICP",
        ),
        (["objects=gear"], "benchmark: objects must be among those of table_6, vertical_bearing_pedestal, "),
        (["trainer.max_epoch=3"], "benchmark: there is no setting 'trainer.max_epoch', did you mean"),
    ],
)
def test_what_cannot_be_is_said_before_any_work(tmp_path: Path, words: list[str], said: str) -> None:
    done = run(tmp_path, "table=table_6", "experiment=smoke", *words)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.strip().splitlines()[-1].startswith(said)
    assert not (tmp_path / "page.md").exists()


@pytest.mark.parametrize("known", ["", "frozen: {zebra: abc}\n"])
def test_the_frozen_scenes_are_recorded_by_digest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, known: str) -> None:
    """And an evaluation on scenes with another digest says so."""
    from omegaconf import OmegaConf

    from attentionvote.workflows.evaluate.frozen_set import generated_set, is_recorded, set_spec

    recorded = tmp_path / "benchmark.yaml"
    recorded.write_text(f"# why\ndefaults:\n- default\nsplit: benchmark\n{known}")
    monkeypatch.setattr(benchmark, "RECORDED", recorded)
    few = ["evaluation.cycles=1", "simulation=smoke", "simulation.drop_counts=[1]", "workers=1"]
    told = ",".join(repr(word) for word in few)
    cfg = compose(TablesSettings, ["table=table_5", f"root={tmp_path}", f"evaluate=[{told}]"])
    monkeypatch.setenv("ATTENTIONVOTE_DATA", str(tmp_path))
    answer = benchmark.record(cfg, ["bunny", "brick"])  # the first has no mesh here
    own = compose(EvaluateSettings, ["object=brick", "evaluation=benchmark", f"root={tmp_path}", *few])
    part = own.object()
    frozen = generated_set(own, part, set_spec(own, part))
    assert answer["frozen"] == {"brick": frozen.scenes.digest} | ({"zebra": "abc"} if known else {})
    assert recorded.read_text().startswith("# why\ndefaults:\n")
    assert list(OmegaConf.load(recorded).frozen) == list(answer["frozen"])
    for digest, expected in ((frozen.scenes.digest, True), ("0" * 64, False)):
        known = replace(own, evaluation=replace(own.evaluation, frozen={"brick": digest}))
        assert is_recorded(known, part, frozen) is expected
    nothing = replace(own, evaluation=replace(own.evaluation, frozen={}))
    assert is_recorded(nothing, part, frozen) is None
