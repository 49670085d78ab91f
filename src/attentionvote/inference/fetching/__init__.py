"""Bundles from a registry, over plain HTTP."""
