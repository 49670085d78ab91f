"""MLflow's own description of a registered bundle: ``MLmodel`` and what it names, beside the bundle's files.

The signed manifest does not name these files, so a cell neither fetches nor reads them.
"""

from __future__ import annotations

import platform
import warnings
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path

from attentionvote.inference import Bundle
from attentionvote.inference.bundles.manifest import MODEL

LOADER = "attentionvote.registry.pyfunc"
# With the versions of the card and this package's own; the package itself is no public one and is installed by hand.
_NEEDED = ("numpy", "scipy", "onnxruntime", "cryptography", "pandas", "onnx")


def write_flavours(folder: Path, bundle: Bundle, model_id: str, run_id: str | None) -> None:
    """Write what ``mlflow.pyfunc.load_model`` and ``mlflow.onnx.load_model`` read.

    Args:
        folder: an empty one.
        bundle: that is registered.
        model_id: of MLflow's logged model.
        run_id: of the training; None when it is unknown.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # MLflow's own type hints displease it at import
        import mlflow.pyfunc
        from mlflow.models import Model, ModelSignature
        from mlflow.types import ColSpec, DataType, Schema

    from attentionvote.registry.pyfunc import PART, POINT, POSE

    card = bundle.card
    # Without names, so that arrays are taken as well as frames.
    inputs = Schema([ColSpec(DataType.double) for _ in POINT])
    outputs = Schema([*(ColSpec(DataType.double, name) for name in POSE), ColSpec(DataType.string, PART)])
    about = {
        "part": card.part.name,
        "part_digest": card.part.digest,
        "bundle_digest": bundle.digest,
        "inputs": "points (N, 3), metres, camera frame: columns x, y, z",
    }
    model = Model(
        run_id=run_id, signature=ModelSignature(inputs=inputs, outputs=outputs), metadata=about, model_id=model_id
    )
    mlflow.pyfunc.add_to_model(model, loader_module=LOADER, python_env="python_env.yaml", model_config={"threads": 1})
    model.add_flavor(
        "onnx", onnx_version=_version("onnx", card.versions), data=MODEL, providers=["CPUExecutionProvider"]
    )
    model.save(str(folder / "MLmodel"))
    named = [f"{name}=={version}" for name in _NEEDED if (version := _version(name, card.versions))]
    requirements = "\n".join([f"mlflow=={mlflow.__version__}", *named])
    (folder / "requirements.txt").write_text(f"{requirements}\n")
    (folder / "python_env.yaml").write_text(
        f"python: {platform.python_version()}\nbuild_dependencies:\n- pip\ndependencies:\n- -r requirements.txt\n"
    )


def _version(name: str, recorded: Mapping[str, str]) -> str:
    """As the card has it, else the one here; empty where there is none."""
    if name in recorded:
        return recorded[name]
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""
