"""The verb evaluate: figures of the exported bundle, once, into the training's run."""

from __future__ import annotations

import json

import evaluate
import pytest

from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.tracking.run_opening import start_run
from attentionvote.tracking.store import connect
from attentionvote.workflows.evaluate.settings import EvaluateSettings


@pytest.fixture
def run(few_scenes):
    """The verb with a few scenes and some more settings."""

    def call(*words: str):
        return evaluate.run(compose(EvaluateSettings, [*few_scenes, *words]))

    return call


def test_figures_go_to_the_json_line_the_file_and_the_trainings_run(run, export_brick, put_tables, tmp_path, capsys):
    store = put_tables(tmp_path / "mlflow.db")
    with start_run(store, "brick", repository=tmp_path, system_interval_s=0) as training:
        pass
    bundle = export_brick("model", training.id)
    result = run(f"tracking.store={store}")
    assert (result["bundle"], result["run_id"], result["scenes"]) == (bundle.digest, training.id, 2)
    assert result["working_point"] == 0.5
    (generated,) = tmp_path.rglob("evaluation-*/manifest.json")
    assert result["scene_set"] == json.loads(generated.read_text())["content_digest"]
    assert {"ap_10", "ap_5", "ap_2", "recall_10", "latency_p50_ms", "latency_p95_ms"} <= set(result["figures"])
    assert set(result["intervals"]) == {"ap_10", "ap_5", "ap_2", "precision_10", "recall_10"}
    said = " ".join(capsys.readouterr().err.split())
    assert "AP at 10 % D" in said
    assert "an estimate, p50 / p95" in said
    client = connect(store)
    stored = client.get_run(training.id)
    assert stored.info.status == "FINISHED"
    assert stored.data.metrics["evaluation/ap_10"] == result["figures"]["ap_10"]
    assert stored.data.metrics["evaluation/recall_10_high"] == result["intervals"]["recall_10"][1]
    assert stored.data.tags["evaluation.set"] == result["evaluation_set"]
    (file,) = client.list_artifacts(training.id, "evaluation")
    assert json.loads((tmp_path / "mlartifacts" / training.id / "artifacts" / file.path).read_text()) == result
    client.delete_tag(training.id, "evaluation.set")  # as if the store had been away
    # Done is done, but the run gets the figures again; force repeats the measurement.
    assert run(f"tracking.store={store}") == result
    assert client.get_run(training.id).data.tags["evaluation.set"] == result["evaluation_set"]
    again = run(f"tracking.store={store}", "force=true")
    assert again["figures"]["latency_p50_ms"] != result["figures"]["latency_p50_ms"]
    assert again["figures"]["ap_10"] == result["figures"]["ap_10"]


def test_a_set_of_one_cycle_has_figures_and_no_interval(run, export_brick, capsys):
    export_brick("model")
    result = run("evaluation.cycles=1", "evaluation.keep_every=1")
    assert (result["scenes"], result["intervals"]) == (2, {})
    assert {"ap_10", "recall_10"} <= set(result["figures"])
    assert "one cycle, no interval" in " ".join(capsys.readouterr().err.split())


def test_another_peak_threshold_is_another_evaluation_and_not_the_runs_figures(run, export_brick, put_tables, tmp_path):
    store = put_tables(tmp_path / "mlflow.db")
    with start_run(store, "brick", repository=tmp_path, system_interval_s=0) as training:
        pass
    export_brick("model", training.id)
    usual = run(f"tracking.store={store}")
    nothing = run(f"tracking.store={store}", "evaluation.peak_threshold=1000.0")
    assert usual["figures"]["duplicates_10"] + usual["figures"]["strays_10"] > 0
    assert nothing["figures"]["duplicates_10"] + nothing["figures"]["strays_10"] == 0
    assert run(f"tracking.store={store}") == usual
    client = connect(store)
    assert client.get_run(training.id).data.metrics["evaluation/strays_10"] == usual["figures"]["strays_10"]
    assert len(client.list_artifacts(training.id, "evaluation")) == 2


def test_another_distance_is_another_set_and_not_the_runs_figures(run, export_brick, put_tables, tmp_path):
    store = put_tables(tmp_path / "mlflow.db")
    with start_run(store, "brick", repository=tmp_path, system_interval_s=0) as training:
        pass
    export_brick("model", training.id)
    usual = run(f"tracking.store={store}")
    near = run(f"tracking.store={store}", "simulation.camera.distance=0.35")
    assert near["scene_set"] != usual["scene_set"]
    client = connect(store)
    assert client.get_run(training.id).data.tags["evaluation.set"] == usual["evaluation_set"]
    assert len(client.list_artifacts(training.id, "evaluation")) == 2


def test_a_run_that_is_gone_costs_a_warning_not_the_figures(run, export_brick, put_tables, tmp_path, caplog):
    export_brick("model", "feed" * 8)
    result = run(f"tracking.store={put_tables(tmp_path / 'mlflow.db')}")
    assert result["scenes"] == 2
    assert f"not in the training's run, the same command tries again: run {'feed' * 8} must be in sqlite" in caplog.text


def test_the_set_is_the_same_for_everybody_and_its_own(run, export_brick):
    export_brick("one")
    first = run()["evaluation_set"]
    assert run("evaluation.threads=2")["evaluation_set"] == first
    assert run("simulation.seed=1")["evaluation_set"] != first
    assert run("evaluation.sensor.sigma_mm=0.5")["evaluation_set"] != first


def test_a_bundle_is_chosen_by_its_digest(run, export_brick):
    first, second = export_brick("one"), export_brick("two")
    assert run()["bundle"] == second.digest
    assert run(f"bundle='{first.digest[:6]}'")["bundle"] == first.digest
    with pytest.raises(
        ConfigurationError, match=r"bundle must name one bundle, 'zz' names 0; there are \w{12}, \w{12}"
    ):
        run("bundle=zz")


def test_what_cannot_be_evaluated_is_said_before_any_work(run, export_brick, tmp_path):
    with pytest.raises(ConfigurationError, match="export/brick must hold a bundle, got none: run `make export OBJECT"):
        run()
    export_brick("other", card={"part": {"name": "brick", "digest": "9" * 64}})
    with pytest.raises(ConfigurationError, match=r"must be of the part brick as it is now \(\w+\), got 999999999999"):
        run()
    bundle = export_brick("model")
    card = tmp_path / "outputs" / "export" / "brick" / bundle.digest[:12] / "card.json"
    card.write_text(card.read_text() + " ")
    with pytest.raises(ConfigurationError, match=r"card\.json must have \d+ bytes, got \d+"):
        run()
    assert not (tmp_path / "data").exists()


def test_a_set_that_the_model_was_trained_with_is_refused(run, export_brick, tmp_path):
    export_brick("one")
    run()
    (manifest,) = (tmp_path / "data" / "scenes" / "brick").glob("evaluation-*/manifest.json")
    digest = json.loads(manifest.read_text())["content_digest"]
    export_brick("two", card={"data": {"train": digest, "val": "2" * 64, "test": "3" * 64}})
    with pytest.raises(ConfigurationError, match="must not be one that the model was trained with, but it is: change"):
        run()
