"""Exchange between the processes of one training; where there is one process every function is the identity.

``torchrun`` starts the processes, ``joined`` makes them a group. Numbers of the network go through the group's own
backend (gloo on a CPU, nccl on GPUs), Python objects through gloo. Where one process works for minutes or hours and
the others wait for it (scenes, clouds), they look into the group's store from time to time: a collective operation
would end by its timeout, and would not hear Ctrl-C.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

T = TypeVar("T")
# Does the work in the first process, gives its result (plain JSON values) to all; the name is used once a training.
FirstDoes = Callable[[str, Callable[[], Any]], Any]

# Longest wait within a training: the first process measures, draws and stores while the others wait for it.
_TIMEOUT = timedelta(hours=1)
_LOOK_S = 0.2
_objects: dist.ProcessGroup | None = None


def count() -> int:
    """Processes that share every batch."""
    return dist.get_world_size() if dist.is_initialized() else 1


def rank() -> int:
    """Which of them this is, from 0."""
    return dist.get_rank() if dist.is_initialized() else 0


def summed(values: Tensor) -> Tensor:
    """The sum over the processes, element by element; carries no gradient."""
    if count() == 1:
        return values.detach()
    total = values.detach().clone()
    dist.all_reduce(total)
    return total


def everyones(values: Tensor) -> Tensor:
    """The values of all processes, stacked in the order of their ranks; carries no gradient.

    Every process gets the same bits, which a sum need not give.
    """
    local = values.detach().contiguous()
    if count() == 1:
        return local[None]
    rows = [torch.empty_like(local) for _ in range(count())]
    dist.all_gather(rows, local)
    return torch.stack(rows)


def in_order(share: Sequence[T]) -> list[T]:
    """The shares of all processes one after the other, in the first process; an empty list in the others."""
    if count() == 1:
        return list(share)
    shares: list[Any] | None = [None] * count() if rank() == 0 else None
    dist.gather_object(list(share), shares, dst=0, group=_objects)
    return [] if shares is None else [item for part in shares for item in part]


def from_first(value: T) -> T:
    """The first process's value in every process."""
    if count() == 1:
        return value
    values = [value]
    dist.broadcast_object_list(values, src=0, group=_objects)
    return values[0]


@contextmanager
def joined(device: torch.device) -> Iterator[FirstDoes]:
    """Meet the other processes that ``torchrun`` has started, and part from them when all are ready.

    Args:
        device: this process's, for the backend: nccl for a CUDA device, gloo for everything else.

    Yields:
        what lets the first process work alone while the others wait, for as long as it takes.
    """
    global _objects
    store, process_rank, world_size = next(dist.rendezvous("env://"))
    if device.type == "cuda":
        torch.cuda.set_device(device)
    cuda = device if device.type == "cuda" else None
    dist.init_process_group(
        "nccl" if cuda else "gloo",
        store=dist.PrefixStore("group", store),
        rank=process_rank,
        world_size=world_size,
        timeout=_TIMEOUT,
        device_id=cuda,
    )
    _objects = dist.new_group(backend="gloo", timeout=_TIMEOUT)

    def first_does(name: str, work: Callable[[], Any]) -> Any:
        key = f"first/{name}"
        if process_rank == 0:
            result = work()
            store.set(key, json.dumps(result))
            return result
        while not store.check([key]):
            time.sleep(_LOOK_S)
        return json.loads(store.get(key))

    try:
        yield first_does
        # The first one leaves last: the store may be in its process, and torchrun elsewhere would not wait for long.
        first_does("end", lambda: None)
        if process_rank:
            store.set(f"left/{process_rank}", "")
        else:
            store.wait([f"left/{other}" for other in range(1, world_size)], _TIMEOUT)
        dist.destroy_process_group()
    finally:
        _objects = None


def is_echo(error: BaseException) -> bool:
    """Whether an error only says that another process is gone."""
    if isinstance(error, dist.DistError):
        return True
    text = str(error).lower()
    return isinstance(error, RuntimeError) and any(word in text for word in ("gloo", "by peer", "nccl"))
