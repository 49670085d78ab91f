"""``export_script.py MODEL CARD OUT ...``: export in a process without the shape checks, which cannot be traced."""

import sys
from pathlib import Path

from attentionvote.contract import ModelCard
from attentionvote.export.onnx_file import export_graph
from attentionvote.training.checkpoint import load_trained

paths = [Path(word) for word in sys.argv[1:]]
for model, card, out in zip(paths[::3], paths[1::3], paths[2::3], strict=True):
    out.write_bytes(export_graph(load_trained(model)[0], ModelCard.from_json(card.read_text(encoding="utf-8"))))
