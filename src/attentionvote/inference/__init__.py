"""The cell's side: a verified bundle in, poses out, and the server around it. No training stack in the process.

The public names are loaded on first use: checking a bundle needs no runtime, and ``--help`` needs nothing at all.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from attentionvote.inference.answer import Abstention, Detection, Estimate
    from attentionvote.inference.bundles.bundle import Bundle, GoldenCloud, load_bundle
    from attentionvote.inference.bundles.manifest import write_manifest
    from attentionvote.inference.bundles.signature import keys_folder, load_private_key, load_public_key, make_keys
    from attentionvote.inference.cell import Cell, read_cell
    from attentionvote.inference.crop import Crop
    from attentionvote.inference.errors import BundleError, DeadlineExceeded, InputError
    from attentionvote.inference.estimator import PoseEstimator
    from attentionvote.inference.golden import self_test
    from attentionvote.inference.scans.cloud_files import read_cloud
    from attentionvote.inference.scans.depth_files import CameraIntrinsics, read_depth

_NAMES = {
    "answer": ("Abstention", "Detection", "Estimate"),
    "bundles.bundle": ("Bundle", "GoldenCloud", "load_bundle"),
    "bundles.manifest": ("write_manifest",),
    "bundles.signature": ("keys_folder", "load_private_key", "load_public_key", "make_keys"),
    "cell": ("Cell", "read_cell"),
    "crop": ("Crop",),
    "errors": ("BundleError", "DeadlineExceeded", "InputError"),
    "estimator": ("PoseEstimator",),
    "golden": ("self_test",),
    "scans.cloud_files": ("read_cloud",),
    "scans.depth_files": ("CameraIntrinsics", "read_depth"),
}
_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names}

__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
