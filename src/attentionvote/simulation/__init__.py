"""Parts, scenes and sensors: everything that makes training data."""

from attentionvote.simulation.part_files import load_part, load_parts

__all__ = ["load_part", "load_parts"]  # named by `_target_` in conf/object/
