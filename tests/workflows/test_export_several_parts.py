"""The verbs export and evaluate on a model of two parts: a bundle whose card, golden clouds and answers name them."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import torch
import warm_starter

from attentionvote.command.configuration import compose
from attentionvote.evaluation.by_part import COUNTS
from attentionvote.inference import PoseEstimator, load_bundle
from attentionvote.model.network import AttentionVote
from attentionvote.part import PartSet
from attentionvote.simulation.scene_set import SceneSet
from attentionvote.training.checkpoint import save_trained
from attentionvote.workflows.settings import GenerateSettings
from attentionvote.workflows.train.network import described, network_arguments
from attentionvote.workflows.train.settings import TrainSettings

ROOT = Path(__file__).resolve().parents[2]
OBJECT = ["object=industrial", "~object.parts.vertical_bearing_pedestal"]
SCENES = [*OBJECT, "simulation=smoke", "simulation.cycles={train:1,val:1,test:2}", "simulation.drop_counts=[2,4]"]
NETWORK = [
    "model.centers=[64,32,16,8]", "model.neighbors=[16,8,8,4]", "model.widths=[[8,16],[16,16],[16,16],[16,16]]",
    "model.propagation=[16,16]", "model.voting=[16]", "model.fusion=[16,16]", "model.head=[16]", "model.proposals=8",
    "model.gathered=8", "model.refinement.points=24", "model.refinement.widths=[8,16]", "model.refinement.head=[16]",
    "model.voxel_fraction=0.2", "model.radius_fraction=0.2", "model.refinement_steps=1",
]  # fmt: skip
NAMES = ("connecting_rod", "slider_bearing_pedestal")


def python(script: str, *words: str, folder: Path) -> dict[str, Any]:
    """What a pipeline in a process of its own answers, with keys in ``folder``."""
    environment = os.environ | {"ATTENTIONVOTE_KEYS": str(folder / "keys")}
    command = [sys.executable, str(ROOT / "pipelines" / script), *words]
    done = warm_starter.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=1500, check=False
    )
    assert done.returncode == 0, done.stderr
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with scenes and a training of a small network that knows nothing but where its votes begin."""
    folder = tmp_path_factory.mktemp("trained")
    python("generate.py", *SCENES, "splits=[test]", "workers=1", folder=folder)
    cfg = compose(TrainSettings, [*OBJECT, "experiment=compact", *NETWORK])
    parts: PartSet = cfg.object()
    network = network_arguments(cfg.model, parts)
    torch.manual_seed(0)
    scenes = SceneSet.open(next((folder / "data" / "scenes" / "industrial").glob("test-*")))
    metadata = {
        "format": 1, "version": "0.1.0", "model": network, "points": 400,
        "clouds": {"sensor": {"preset": "none"}, "density": 2000, "pool": 1000, "neighbors": 12},
        "peak_threshold": 0.05, "confidence_threshold": 0.1, "data": {"test": scenes.digest}, "test": {},
        **described(parts),
    }  # fmt: skip
    training = folder / "outputs" / "train" / "industrial" / "0123456789ab"
    plain = json.loads(json.dumps(metadata))
    save_trained(AttentionVote.from_arguments(network).eval(), plain, training / "model.ckpt")
    (training / "result.json").write_text(json.dumps({"run_id": "", "commit": ""}), encoding="utf-8")
    return folder


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_model_of_two_parts_becomes_a_bundle_and_is_evaluated(trained: Path) -> None:
    exported = python("export.py", *OBJECT, "limits.scenes=2", "scenes=4", "golden=1", "workers=1", folder=trained)
    bundle = load_bundle(trained / exported["bundle"], trained / "keys" / "signing.pub")
    cfg = compose(GenerateSettings, OBJECT)
    parts: PartSet = cfg.object()
    assert bundle.card.classes == NAMES
    assert [part.digest for part in bundle.card.parts] == [part.digest for part in parts.parts]
    assert [part.symmetry for part in bundle.card.parts] == [
        json.loads(json.dumps(asdict(p.symmetry))) for p in parts.parts
    ]
    assert (bundle.path / "part_slider_bearing_pedestal.ply").is_file()
    assert exported["parity"]["CPU"]["pairs"] > 0
    cloud = bundle.golden()[0]
    with PoseEstimator(bundle) as estimator:
        answer = estimator.estimate_parts_only(cloud.points)
    assert [d.part for d in answer.detections] == [NAMES[k] for k in cloud.part_ids]  # type: ignore[union-attr]

    words = ["simulation=smoke", "simulation.drop_counts=[2,4]", "evaluation.cycles=2", "evaluation.density=2000"]
    store = f"tracking.store={trained / 'mlflow.db'}"
    evaluated = python("evaluate.py", *OBJECT, *words, "workers=1", store, folder=trained)
    figures = evaluated["figures"]
    assert evaluated["object"] == "industrial"
    for figure in ("ap_10", "recall_10", "add_recall_10", "strays_10"):
        each = [figures[f"{name}/{figure}"] for name in NAMES]
        expected = sum(each) if figure.startswith(COUNTS) else sum(each) / 2
        assert figures[figure] == pytest.approx(expected, abs=1e-5), figure
    assert {"ap_10", *(f"{name}/ap_10" for name in NAMES)} <= set(evaluated["intervals"])
