"""The exported model on the frozen set of its part."""
