"""Signed bundles of checkpoints: one ONNX graph each, proved equal to its checkpoint in task units."""
