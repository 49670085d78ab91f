"""Bundles: what is in one, who signed it, and how it is read."""
