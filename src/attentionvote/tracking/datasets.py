"""What a run was made with, as MLflow's datasets: name, path, counts, whole digest."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mlflow.entities import DatasetInput

_DIGEST_DIGITS = 32  # MLflow takes 36 characters


@dataclass(frozen=True)
class RunDataset:
    """Data of one use.

    Attributes:
        digest: sha256 of its content.
        name: in MLflow's pages, the same for the same kind of data.
        path: where it lies on the machine that reads it.
        counts: what it holds, by noun.
    """

    digest: str
    name: str
    path: Path
    counts: Mapping[str, int] = field(default_factory=dict)


def dataset_inputs(datasets: Mapping[str, RunDataset]) -> list[DatasetInput]:
    """The inputs of a run, by use; ``mlflow.data.get_source`` finds the path again."""
    from mlflow.entities import Dataset, DatasetInput, InputTag

    return [
        DatasetInput(
            Dataset(
                name=data.name,
                digest=data.digest[:_DIGEST_DIGITS],
                source_type="local",
                source=json.dumps({"uri": str(data.path), "digest": data.digest}),
                profile=json.dumps({**data.counts, "digest": data.digest}),
            ),
            [InputTag("mlflow.data.context", use)],
        )
        for use, data in datasets.items()
    ]
