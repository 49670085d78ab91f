"""From scene sets and datasets to batches: measured clouds, samples, augmentation, the data module.

The public names are loaded on first use, so that the processes that measure clouds do not import torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from attentionvote.data.clouds import Clouds, CloudSettings, measure, measure_clouds
    from attentionvote.data.datamodule import PartDataModule
    from attentionvote.data.samples import Augmentation, Batch, collate, draw_sample

__all__ = [
    "Augmentation",
    "Batch",
    "CloudSettings",
    "Clouds",
    "PartDataModule",
    "collate",
    "draw_sample",
    "measure",
    "measure_clouds",
]

_MODULE_OF = {
    "CloudSettings": "clouds",
    "Clouds": "clouds",
    "measure": "clouds",
    "measure_clouds": "clouds",
    "PartDataModule": "datamodule",
    "Augmentation": "samples",
    "Batch": "samples",
    "collate": "samples",
    "draw_sample": "samples",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
