"""Other people's data and formats: readers of the IPA, Sileane and BOP layouts, writers of IPA and BOP, a check.

Every reader answers in the package's own conventions (metres, OpenCV camera frame, ``camera_from_part``), whatever
the files say: ``open_datasets(folder)`` finds what a folder holds, ``dataset.scene(name)`` is a ``Scene``.
"""

from attentionvote.datasets.dataset import Dataset, GroundTruth
from attentionvote.datasets.depth_image import PinholeCamera
from attentionvote.datasets.recognition import UnknownLayout, open_datasets

__all__ = ["Dataset", "GroundTruth", "PinholeCamera", "UnknownLayout", "open_datasets"]
