"""From a checkpoint to a signed bundle: one ONNX graph, proved equal to the checkpoint in task units."""
