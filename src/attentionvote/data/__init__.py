"""Batches of scene sets and datasets: measured clouds, samples, augmentation, the data module."""
