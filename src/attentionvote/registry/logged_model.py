"""A bundle as a logged model of MLflow: an output of its training's run, with the figures that a promotion measured."""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attentionvote.inference import Bundle
from attentionvote.registry.flavours import write_flavours
from attentionvote.tracking.metric_writer import metric_name

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import LoggedModel

DIGEST_TAG = "bundle.digest"
KIND = "attentionvote bundle"


@dataclass(frozen=True)
class Figures:
    """What was measured of a model.

    Attributes:
        values: by name.
        scenes: digest of the scenes.
        title: of the scenes.
    """

    values: Mapping[str, float] = field(default_factory=dict)
    scenes: str = ""
    title: str = ""


def log_model(
    client: MlflowClient, experiment: str, bundle: Bundle, run: Any, figures: Figures, check: Callable[[str], None]
) -> LoggedModel:
    """Upload a bundle with MLflow's flavours beside it, link it with its run, and let it be ready.

    Args:
        client: of the store.
        experiment: id of the one it belongs to.
        bundle: verified.
        run: of the training, whose parameters become the model's; None when the store does not have it.
        figures: of the bundle.
        check: looks at what the store keeps, by its location, and raises when it is not the bundle.

    Raises:
        Exception: the store's or the check's; the model is left FAILED where the store still answers.
    """
    from mlflow.entities import LoggedModelOutput

    _fail_unfinished(client, experiment)
    run_id: str | None = run.info.run_id if run else None
    model = client.create_logged_model(
        experiment,
        name=f"{bundle.card.part.name}-{bundle.digest[:12]}",
        source_run_id=run_id,
        tags={DIGEST_TAG: bundle.digest, "part": bundle.card.part.name},
        model_type=KIND,
    )
    try:
        client.log_model_artifacts(model.model_id, str(bundle.path))
        with tempfile.TemporaryDirectory(prefix="attentionvote-") as folder:
            write_flavours(Path(folder), bundle, model.model_id, run_id)
            client.log_model_artifacts(model.model_id, folder)
        check(model.artifact_location)
        if run_id is not None:
            client.log_model_params(model.model_id, dict(run.data.params))
            client.log_outputs(run_id, [LoggedModelOutput(model.model_id, step=0)])
            _log_figures(client, run_id, model.model_id, figures)
        return client.finalize_logged_model(model.model_id, "READY")
    except BaseException:
        with contextlib.suppress(Exception):  # the store may be what failed: the next promotion does it then
            client.finalize_logged_model(model.model_id, "FAILED")
        raise


def _log_figures(client: MlflowClient, run_id: str, model_id: str, figures: Figures) -> None:
    from mlflow.entities import Metric

    now = int(1000 * time.time())
    about: dict[str, Any] = {"run_id": run_id, "model_id": model_id}
    if figures.scenes:
        about |= {"dataset_name": figures.title, "dataset_digest": figures.scenes[:32]}
    metrics = [
        Metric(metric_name(f"evaluation/{name}"), value, now, 0, **about) for name, value in figures.values.items()
    ]
    client.log_batch(run_id, metrics=metrics)


def _fail_unfinished(client: MlflowClient, experiment: str) -> None:
    """Models whose upload was cut off, by a server that died say, are not left as if it still went on.

    One that another process is just uploading becomes READY all the same when it is done.
    """
    newest = client.search_logged_models([experiment], f"model_type = '{KIND}'")  # by status MLflow 3.17 cannot search
    for model in newest:
        if model.status == "PENDING":
            client.finalize_logged_model(model.model_id, "FAILED")
