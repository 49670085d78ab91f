"""A registered bundle as a user of MLflow meets it: loaded, compared, served, and what a server's death leaves."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import warnings
from collections.abc import Iterator

import numpy as np
import pandas as pd
import pytest
from tiny_bundle import tiny_cloud

from attentionvote.inference import BundleError, PoseEstimator, load_bundle
from attentionvote.inference.bundles.manifest import BESIDE
from attentionvote.registry.logged_model import Figures
from attentionvote.registry.pyfunc import POINT, POSE, _load_pyfunc
from attentionvote.registry.versions import Versions
from attentionvote.tracking.run_opening import start_run
from attentionvote.tracking.server import serve
from attentionvote.tracking.server_check import store_failures
from attentionvote.tracking.store import connect, experiment_id, resolve_store


@contextlib.contextmanager
def in_mlflow(uri: str) -> Iterator[None]:
    """A user's session: MLflow's own global store."""
    import mlflow

    mlflow.set_tracking_uri(uri)
    try:
        yield
    finally:
        mlflow.set_tracking_uri(None)
        os.environ.pop("MLFLOW_TRACKING_URI", None)


@pytest.fixture
def trained(versions, make_bundle, trusted_key):
    """A bundle of a run of the store."""
    with start_run(versions.uri, "bracket", params={"loss.weights.vote": 2.0}, system_interval_s=0) as run:
        pass
    return load_bundle(make_bundle("of_a_run", card={"run_id": run.id}), trusted_key)


def test_mlflow_loads_what_a_cell_serves(versions, trained, trusted_key, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # MLflow's own, at import
        import mlflow.onnx
        import mlflow.pyfunc

    version = versions.register(trained, {"ap_10": "0.9800"}, description="**good**")
    versions.set_champion(version)
    cloud = tiny_cloud()
    expected = PoseEstimator(trained).estimate(cloud).detections
    uri = f"models:/{versions.name}@champion"
    with in_mlflow(versions.uri):
        model = mlflow.pyfunc.load_model(uri)
        columns = dict(zip(POINT, cloud.T, strict=True))
        for points in (cloud, cloud.astype(float), pd.DataFrame(columns), pd.DataFrame(columns)[["z", "x", "y"]]):
            poses = model.predict(points)
            assert list(poses.columns) == [*POSE, "part"]
            assert list(poses["confidence"]) == [found.confidence for found in expected]
            np.testing.assert_allclose(poses[list(POINT)], [found.camera_from_part[:3, 3] for found in expected])
        nothing = model.predict(np.zeros((2, 3)))
        assert (len(nothing), list(nothing.columns)) == (0, list(poses.columns))
        assert nothing.attrs["answer"] == "abstention"
        assert [entry.name for entry in mlflow.onnx.load_model(uri).graph.input] == ["points", "normals"]
        assert [entry.name for entry in model.metadata.signature.outputs.inputs] == [*POSE, "part"]
    # MLflow has written beside the files meanwhile; the version is the bundle all the same, and a folder of it too.
    assert versions.fetch(version, tmp_path / "fetched", trusted_key).digest == trained.digest
    (folder,) = (path.parent for path in (tmp_path / "fetched").rglob("MLmodel"))
    assert load_bundle(folder, trusted_key).digest == trained.digest
    assert versions.register(trained, {}).number == version.number
    row = versions.client.get_model_version(versions.name, str(version.number))
    assert (row.description, row.tags["ap_10"]) == ("**good**", "0.9800")


def test_a_logged_model_is_an_output_of_its_run_with_parameters_and_figures(versions, trained):
    version = versions.register(trained, {}, Figures({"ap_10": 0.5}, "ab" * 32, "bracket/evaluation"))
    source = versions.client.get_model_version(versions.name, str(version.number)).source
    model = versions.client.get_logged_model(source.rpartition("/")[2])
    assert (model.status, model.source_run_id) == ("READY", trained.card.run_id)
    assert model.params == {"loss.weights.vote": "2.0"}
    assert [(m.key, m.value, m.dataset_name) for m in model.metrics] == [
        ("evaluation/ap_10", 0.5, "bracket/evaluation")
    ]
    run = versions.client.get_run(trained.card.run_id)
    assert [output.model_id for output in run.outputs.model_outputs] == [model.model_id]
    assert run.data.metrics == {"evaluation/ap_10": 0.5}


def test_the_loader_takes_bundles_alone_and_names_columns(make_bundle, tmp_path):
    folder = shutil.copytree(make_bundle(), tmp_path / "copy")
    for name in BESIDE:
        (folder / name).write_text("anything")
    model = _load_pyfunc(str(folder), {"threads": 2})
    with pytest.raises(ValueError, match=r"must have the columns x, y, z, got a, y, z"):
        model.predict(pd.DataFrame(tiny_cloud(), columns=["a", "y", "z"]))
    (folder / "other.txt").write_text("")
    with pytest.raises(BundleError, match=r"other\.txt is not in manifest\.json"):
        _load_pyfunc(str(folder))
    (folder / "other.txt").unlink()
    card = json.loads((folder / "card.json").read_text())
    (folder / "card.json").write_text(json.dumps(card | {"density": 1}))
    with pytest.raises(BundleError, match=r"card\.json must have"):
        _load_pyfunc(str(folder))


def test_a_server_that_dies_in_an_upload_is_one_sentence_and_leaves_nothing_pending(make_model, monkeypatch, tmp_path):
    bundle, store = make_model(), resolve_store(str(tmp_path / "mlflow.db"))
    experiment = experiment_id(connect(store), store, "bracket")  # its artefacts can be reached without the server
    with serve(store) as server:
        versions = Versions(server.url, "bracket")
        upload = versions.client.log_model_artifacts

        def dying(model_id: str, folder: str) -> None:
            upload(model_id, folder)
            os.killpg(server.process.pid, signal.SIGKILL)
            server.process.wait()

        monkeypatch.setattr(versions.client, "log_model_artifacts", dying)
        with pytest.raises(ConnectionError) as caught, store_failures(server.url):
            versions.register(bundle, {})
        assert str(caught.value) == (
            f"the tracking store {server.url} must answer until the work is done, got: Connection refused; run the "
            "same command again, it goes on from there"
        )
    again = Versions(store, "bracket")
    assert again.all() == []
    statuses = lambda: [m.status for m in again.client.search_logged_models([experiment])]  # noqa: E731
    assert statuses() == ["PENDING"]
    assert again.register(bundle, {}).number == 1
    assert sorted(statuses()) == ["FAILED", "READY"]
