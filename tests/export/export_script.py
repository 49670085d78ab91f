"""``export_script.py MODEL CARD OUT``: export in a process without the shape checks, which cannot be traced."""

import sys
from pathlib import Path

from attentionvote.contract import ModelCard
from attentionvote.export import export_graph
from attentionvote.training.checkpoint import load_trained

model, card, out = map(Path, sys.argv[1:])
out.write_bytes(export_graph(load_trained(model)[0], ModelCard.from_json(card.read_text(encoding="utf-8"))))
