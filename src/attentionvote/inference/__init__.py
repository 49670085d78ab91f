"""The cell's side: a verified bundle in, poses out, and the server around it. No training stack in the process.

The public names are loaded on first use: checking a bundle needs no runtime, and ``--help`` needs nothing at all.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from attentionvote.inference.answer import Abstention, Detection, Estimate
    from attentionvote.inference.bundle import Bundle, GoldenCloud, load_bundle, write_manifest
    from attentionvote.inference.cell import Cell, read_cell
    from attentionvote.inference.cloud_files import read_cloud
    from attentionvote.inference.depth_files import CameraIntrinsics, read_depth
    from attentionvote.inference.errors import BundleError, DeadlineExceeded, InputError
    from attentionvote.inference.estimator import PoseEstimator
    from attentionvote.inference.golden import self_test
    from attentionvote.inference.preparation import Crop
    from attentionvote.inference.signature import keys_folder, load_private_key, load_public_key, make_keys

_MODULE_OF = {
    "Abstention": "answer",
    "Bundle": "bundle",
    "BundleError": "errors",
    "CameraIntrinsics": "depth_files",
    "Cell": "cell",
    "Crop": "preparation",
    "DeadlineExceeded": "errors",
    "Detection": "answer",
    "Estimate": "answer",
    "GoldenCloud": "bundle",
    "InputError": "errors",
    "PoseEstimator": "estimator",
    "keys_folder": "signature",
    "load_bundle": "bundle",
    "load_private_key": "signature",
    "load_public_key": "signature",
    "make_keys": "signature",
    "read_cell": "cell",
    "read_cloud": "cloud_files",
    "read_depth": "depth_files",
    "self_test": "golden",
    "write_manifest": "bundle",
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
