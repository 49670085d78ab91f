"""Full precision for positions and rotations, which mixed precision must not touch.

Autocast turns every matrix product into half precision. bfloat16 has eight significant bits: 0.8 m in front of the
camera its steps are 4 mm, and a rotation matrix of it is a third of a degree off.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor


def full_precision(device: torch.device) -> AbstractContextManager[None]:
    """A context in which operations on ``device`` keep the precision of their arguments; nothing without autocast."""
    if not torch.amp.is_autocast_available(device.type) or not torch.is_autocast_enabled(device.type):
        return nullcontext()
    return torch.autocast(device.type, enabled=False)


def widened(values: Tensor) -> Tensor:
    """``values`` in at least float32."""
    return values.to(torch.promote_types(values.dtype, torch.float32))
