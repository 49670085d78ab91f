"""A Triton model repository of a bundle: for GPU cells that run NVIDIA's server instead of this project's.

Triton serves the graph itself: its client crops, estimates normals and samples (``inference.preparation``), and keeps
to the thresholds of the card. This project's own server does that for its clients.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from attentionvote.contract import ModelCard, TensorSpec
from attentionvote.inference.bundle import Bundle


def write_triton(bundle: Bundle, repository: Path, version: int = 1) -> Path:
    """Write ``repository/PART`` with ``config.pbtxt``, ``VERSION/model.onnx`` and the card; its path.

    Raises:
        OSError: when it cannot be written.
    """
    folder = repository / bundle.card.part.name
    place = folder / str(version)
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    (place / "model.onnx").write_bytes(bundle.model)
    (folder / "card.json").write_text(bundle.card.to_json(), encoding="utf-8")
    (folder / "config.pbtxt").write_text(config(bundle.card, version), encoding="utf-8")
    return folder


def config(card: ModelCard, version: int) -> str:
    """The text of ``config.pbtxt``: static shapes, no batching, one instance, one thread."""
    inputs, outputs = (",\n".join(map(_tensor, specs)) for specs in (card.inputs, card.outputs))
    return f"""name: "{card.part.name}"
backend: "onnxruntime"
max_batch_size: 0
input [
{inputs}
]
output [
{outputs}
]
version_policy: {{ specific {{ versions: [ {version} ] }} }}
instance_group [ {{ kind: KIND_CPU, count: 1 }} ]
parameters {{ key: "intra_op_thread_count", value: {{ string_value: "1" }} }}
"""


def _tensor(spec: TensorSpec) -> str:
    return f'  {{ name: "{spec.name}", data_type: TYPE_FP32, dims: [ {", ".join(map(str, spec.shape))} ] }}'
