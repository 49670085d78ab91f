"""The loader of MLflow's ``python_function`` flavour: a version as a function from points to poses.

``mlflow.pyfunc.load_model("models:/attentionvote-PART@champion").predict(points)``, where this package is installed.
Every file is compared with the bundle's manifest. Its signature is not asked for: MLflow has trusted the registry
before it comes here, and a cell, which does not, fetches and verifies without MLflow.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd  # type: ignore[import-untyped]

from attentionvote.inference import BundleError, InputError, PoseEstimator, load_bundle

POINT = ("x", "y", "z")
POSE = (*POINT, "qw", "qx", "qy", "qz", "confidence", "heat")
PART = "part"


class PoseModel:
    """Poses of the parts in a cloud, as MLflow asks for them."""

    def __init__(self, estimator: PoseEstimator) -> None:
        self.estimator = estimator

    def predict(self, points: Any) -> pd.DataFrame:
        """Poses of one cloud, the most confident first.

        Args:
            points: ``(N, 3)`` metres in the camera's frame, an array or a DataFrame whose columns are x, y, z. Parts
                alone or the bin with them: nothing is cropped.

        Returns:
            A row a pose: position x, y, z in metres, quaternion qw, qx, qy, qz, confidence, heat, and the part's name.
            No row when the estimator abstains; why is in ``attrs``.

        Raises:
            InputError: a ValueError, when the points cannot be used.
        """
        answer = self.estimator.estimate(_cloud(points)).to_dict()
        rows = [
            (*pose["position"], *pose["quaternion"], pose["confidence"], pose["heat"], pose["part"])
            for pose in answer["poses"]
        ]
        frame = pd.DataFrame(rows, columns=[*POSE, PART]).astype(dict.fromkeys(POSE, np.float64))
        frame.attrs = {name: answer[name] for name in ("answer", "reason", "message", "warnings") if name in answer}
        return frame


def _cloud(points: Any) -> Any:
    if isinstance(points, pd.DataFrame):
        names = list(points.columns)
        if set(POINT) <= set(names):
            points = points[list(POINT)]
        elif names != [0, 1, 2]:
            raise InputError(f"points must have the columns x, y, z, got {', '.join(map(str, names))}")
        points = points.to_numpy()
    return np.asarray(points, dtype=np.float32)


def _load_pyfunc(path: str, model_config: Mapping[str, Any] | None = None) -> PoseModel:
    """What MLflow calls.

    Args:
        path: folder of the version's files.
        model_config: ``threads`` of an estimate.

    Raises:
        BundleError: when the files are not those of the manifest.
    """
    folder = Path(path)
    try:
        bundle = load_bundle(folder, None)
    except BundleError as error:
        raise BundleError(f"{error} (register the bundle again with `make promote`)") from error
    return PoseModel(PoseEstimator(bundle, threads=int((model_config or {}).get("threads", 1))))
