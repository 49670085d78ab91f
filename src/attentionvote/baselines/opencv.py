"""OpenCV's surface matching: the import, and a number of threads for a while."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType


def surface_matching() -> ModuleType:
    """The module ``cv2`` with its part ``ppf_match_3d``.

    Raises:
        ValueError: when OpenCV is missing, or is a build without the contributed modules.
    """
    advice = "run `make setup`, or install the extra: pip install '.[benchmark]'"
    try:
        import cv2
    except ImportError as error:
        raise ValueError(
            f"the PPF baseline needs opencv-contrib-python-headless, but cv2 is missing: {advice}"
        ) from error
    if not hasattr(cv2, "ppf_match_3d"):
        raise ValueError(
            f"the PPF baseline needs a cv2 with the module ppf_match_3d, but OpenCV {cv2.__version__} here is built "
            f"without it (opencv-python instead of opencv-contrib-python-headless): {advice}"
        )
    return cv2


@contextmanager
def threads(cv2: ModuleType, count: int) -> Iterator[None]:
    """OpenCV on ``count`` threads; what was set before is set again."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(count)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
