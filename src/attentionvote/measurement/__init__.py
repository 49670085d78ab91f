"""Models on frozen scenes: what workflows and registry measure alike."""
