"""From a checkpoint to a signed bundle: one ONNX graph, proved equal to the checkpoint in task units.

The public names are loaded on first use, so that reading a proof's record does not import torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from attentionvote.export.bundle_writer import point_latest, write_bundle
    from attentionvote.export.checkpoint_card import model_card, used_otherwise
    from attentionvote.export.onnx_file import export_graph
    from attentionvote.export.parity import compare, measure_parity
    from attentionvote.export.parity_record import Limits, Parity, table
    from attentionvote.export.triton_layout import write_triton

__all__ = [
    "Limits",
    "Parity",
    "compare",
    "export_graph",
    "measure_parity",
    "model_card",
    "point_latest",
    "table",
    "used_otherwise",
    "write_bundle",
    "write_triton",
]

_MODULE_OF = {
    "point_latest": "bundle_writer",
    "write_bundle": "bundle_writer",
    "model_card": "checkpoint_card",
    "used_otherwise": "checkpoint_card",
    "export_graph": "onnx_file",
    "compare": "parity",
    "measure_parity": "parity",
    "Limits": "parity_record",
    "Parity": "parity_record",
    "table": "parity_record",
    "write_triton": "triton_layout",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
