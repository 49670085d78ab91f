"""A Triton model repository of a bundle: for GPU cells that run NVIDIA's server instead of this project's.

Triton serves the graph itself: its client crops, estimates normals and samples (``inference.preparation``), and keeps
to the thresholds of the card. This project's own server does that for its clients.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from attentionvote.contract import ModelCard, TensorSpec
from attentionvote.inference.bundles.bundle import Bundle


def write_triton(bundle: Bundle, repository: Path, version: int = 1) -> Path:
    """Write ``repository/PART`` with ``config.pbtxt``, ``VERSION/model.onnx`` and the card; its path.

    The folder is exchanged as a whole, so that a server that polls it never reads halves.

    Raises:
        OSError: when it cannot be written.
    """
    folder = repository / bundle.card.part.name
    draft, old = (repository / f".{folder.name}.{state}" for state in ("writing", "old"))
    for leftover in (draft, old):
        shutil.rmtree(leftover, ignore_errors=True)
    (draft / str(version)).mkdir(parents=True)
    (draft / str(version) / "model.onnx").write_bytes(bundle.model)
    (draft / "card.json").write_text(bundle.card.to_json(), encoding="utf-8")
    (draft / "config.pbtxt").write_text(config(bundle.card, version), encoding="utf-8")
    if folder.exists():
        folder.rename(old)
    draft.rename(folder)
    shutil.rmtree(old, ignore_errors=True)
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
