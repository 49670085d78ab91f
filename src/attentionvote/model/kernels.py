"""The network's C functions, where they can serve."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from attentionvote.geometry import native


def kernels(file: str, *tensors: Tensor) -> ctypes.CDLL | None:
    """The functions of a C file of this folder, for tensors whose memory they would read.

    None where there is no compiler, while a graph is traced, and for tensors that are not float32 on a CPU: under
    autocast only a projection would be of half precision.
    """
    plain = all(t.device.type == "cpu" and t.dtype == torch.float32 for t in tensors)
    if not plain or torch.compiler.is_compiling():
        return None
    return native.load("attentionvote.model", file, tuned=True)
