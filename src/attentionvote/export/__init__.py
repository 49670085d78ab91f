"""From a checkpoint to a signed bundle: one ONNX graph, proved equal to the checkpoint in task units."""

from attentionvote.export.bundle_writer import point_latest, write_bundle
from attentionvote.export.model_card import model_card
from attentionvote.export.onnx_file import export_graph
from attentionvote.export.parity import Limits, Parity, compare, measure_parity, table
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
    "write_bundle",
    "write_triton",
]
