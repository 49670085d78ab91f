"""From scene sets to batches: measured clouds, samples, augmentation, the data module."""

from attentionvote.data.clouds import Clouds, CloudSettings, measure, measure_clouds
from attentionvote.data.samples import Augmentation, Batch, collate, draw_sample

__all__ = ["Augmentation", "Batch", "CloudSettings", "Clouds", "collate", "draw_sample", "measure", "measure_clouds"]
