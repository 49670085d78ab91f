"""Lightning's checkpoints, written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO

from attentionvote.training.checkpoint import write_atomically


class AtomicCheckpoints(TorchCheckpointIO):
    """Lightning's checkpoint files, written beside their place and renamed.

    Lightning's own writer goes through the machine's temporary folder, often another file system, from which a
    file is copied, not renamed: a kill -9 there leaves half a checkpoint.

    Args:
        before_save: called before each: what a continued training takes for stored must be stored by then.
    """

    def __init__(self, before_save: Callable[[], object] | None = None) -> None:
        self.before_save = before_save

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | os.PathLike, storage_options: Any = None) -> None:
        """Write ``checkpoint`` to ``path``.

        Raises:
            OSError: with one sentence; the file that was there stays.
        """
        del storage_options
        if self.before_save is not None:
            self.before_save()
        write_atomically(checkpoint, Path(path))
