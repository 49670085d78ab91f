"""The cell's side: a verified bundle in, poses out, and the server around it. No training stack in the process.

The public names are loaded on first use: checking a bundle needs no runtime, and ``--help`` needs nothing at all.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from attentionvote.inference.answer import Abstention, Detection, Estimate
    from attentionvote.inference.bundles.bundle import Bundle, GoldenCloud, load_bundle, write_manifest
    from attentionvote.inference.bundles.signature import keys_folder, load_private_key, load_public_key, make_keys
    from attentionvote.inference.cell import Cell, read_cell
    from attentionvote.inference.crop import Crop
    from attentionvote.inference.errors import BundleError, DeadlineExceeded, InputError
    from attentionvote.inference.estimator import PoseEstimator
    from attentionvote.inference.golden import self_test
    from attentionvote.inference.scans.cloud_files import read_cloud
    from attentionvote.inference.scans.depth_files import CameraIntrinsics, read_depth

_MODULE_OF = {
    "Abstention": "answer",
    "Bundle": "bundles.bundle",
    "BundleError": "errors",
    "CameraIntrinsics": "scans.depth_files",
    "Cell": "cell",
    "Crop": "crop",
    "DeadlineExceeded": "errors",
    "Detection": "answer",
    "Estimate": "answer",
    "GoldenCloud": "bundles.bundle",
    "InputError": "errors",
    "PoseEstimator": "estimator",
    "keys_folder": "bundles.signature",
    "load_bundle": "bundles.bundle",
    "load_private_key": "bundles.signature",
    "load_public_key": "bundles.signature",
    "make_keys": "bundles.signature",
    "read_cell": "cell",
    "read_cloud": "scans.cloud_files",
    "read_depth": "scans.depth_files",
    "self_test": "golden",
    "write_manifest": "bundles.bundle",
}

__all__ = [
    "Abstention",
    "Bundle",
    "BundleError",
    "CameraIntrinsics",
    "Cell",
    "Crop",
    "DeadlineExceeded",
    "Detection",
    "Estimate",
    "GoldenCloud",
    "InputError",
    "PoseEstimator",
    "keys_folder",
    "load_bundle",
    "load_private_key",
    "load_public_key",
    "make_keys",
    "read_cell",
    "read_cloud",
    "read_depth",
    "self_test",
    "write_manifest",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
