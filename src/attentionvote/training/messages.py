"""Messages of Lightning and torch during a training, and the few of them that are for people."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

# Advice of Lightning and torch that does not fit: loaders cost a few milliseconds a sample, a continued training finds
# its own checkpoints, and the rest is between Lightning and torch.
_CHATTER = (
    ".*does not have many workers.*",
    ".*exists and is not empty.*",
    ".*treespec, LeafSpec.*",
    ".*LeafSpec.*is deprecated.*",
    ".*The number of training batches .* is smaller than the logging interval.*",
    # Of several processes: what is logged is the same in all of them already, and the warm-up leaves parameters unused.
    ".*`self.log.*sync_dist=True.*",
    ".*find_unused_parameters=True was specified.*",
    ".*`ModelCheckpoint.monitor=.*could not find the monitored key.*",
)


@contextmanager
def quiet_lightning() -> Iterator[None]:
    """Lightning's banners and advice stay out of the way of what matters."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    logging.getLogger("lightning.fabric").setLevel(logging.WARNING)
    with warnings.catch_warnings():
        for message in _CHATTER:
            warnings.filterwarnings("ignore", message)
        yield


@contextmanager
def plain_loader_errors() -> Iterator[None]:
    """What fails in a loader process arrives with its traceback as message: only its last line is for people."""
    try:
        yield
    except (ValueError, OSError) as error:
        text = str(error)
        if not text.startswith("Caught "):
            raise
        raise type(error)(text.strip().splitlines()[-1].partition(": ")[2]) from error
