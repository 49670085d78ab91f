"""Numbers that every call needs: copied to a device once, not once a call."""

from __future__ import annotations

import torch
from torch import Tensor


class Constant:
    """A small table.

    No buffer of a module: it belongs to no checkpoint, and a moving average of the weights must not touch it.

    Args:
        values: as precise as they are known; what is handed out is rounded from them.
    """

    def __init__(self, values: Tensor) -> None:
        self._values, self._numbers = values, values.tolist()
        self._copies: dict[tuple[torch.device, torch.dtype], Tensor] = {}

    def on(self, device: torch.device, dtype: torch.dtype) -> Tensor:
        """The table on a device and in a precision; not to be written to."""
        if torch.compiler.is_compiling():  # a number of the graph; a copy of now would be an input of it
            return torch.tensor(self._numbers, dtype=dtype, device=device)
        key = device, dtype
        if key not in self._copies:
            with torch.inference_mode(False):  # a training may need it after a validation was the first to ask
                # Narrowed first: not every device knows double precision.
                self._copies[key] = self._values.to(dtype).to(device)
        return self._copies[key]

    def like(self, values: Tensor) -> Tensor:
        """The table on the device and in the precision of ``values``."""
        return self.on(values.device, values.dtype)
