"""What a user would take today without learning, measured beside the network.

OpenCV is imported only when a detector is made; it comes with the extra ``benchmark``.
"""

from attentionvote.baselines.opencv import check_opencv
from attentionvote.baselines.ppf import Detections, PpfDetector, PpfSettings

__all__ = ["Detections", "PpfDetector", "PpfSettings", "check_opencv"]
