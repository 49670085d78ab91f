"""From scene sets and datasets to batches: measured clouds, samples, augmentation, the data module."""
