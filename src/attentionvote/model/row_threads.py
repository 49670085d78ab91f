"""Rows shared out over threads: how every C function of the network uses more than one processor.

The threads are those of torch's own OpenMP. After each of its operations they wait for the next one without giving up
their processors, for milliseconds; threads of any other kind would have to share these with them.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import torch

LEAST_ROWS = 64  # of a share: less is not worth waking a thread

_Region = ctypes.CFUNCTYPE(None, ctypes.c_void_p)


def thread_count(rows: int, least: int = LEAST_ROWS) -> int:
    """Shares that ``rows`` are worth: at most torch's threads, each of at least ``least`` rows, never less than one."""
    return max(1, min(torch.get_num_threads(), rows // least))


def in_threads(rows: int, work: Callable[[int, int, int], object], least: int = LEAST_ROWS) -> None:
    """``work(share, start, stop)`` over equal shares of the rows, ``thread_count(rows, least)`` of them at once.

    Which rows a share has depends on nothing but their number and that of the threads. What ``work`` raises is raised
    here, when all shares are done.
    """
    count = thread_count(rows, least)
    if count == 1:
        work(0, 0, rows)
        return
    bounds = [rows * i // count for i in range(count + 1)]
    errors: list[BaseException] = []

    def share(index: int) -> None:
        try:
            work(index, bounds[index], bounds[index + 1])
        except BaseException as error:
            errors.append(error)

    library = _openmp()
    if library is None:
        list(_pool().map(share, range(count)))
    else:

        def region(_: object) -> None:
            # The runtime may give fewer threads than it was asked for.
            for index in range(library.omp_get_thread_num(), count, library.omp_get_num_threads()):
                share(index)

        library.GOMP_parallel(_Region(region), None, count, 0)
    if errors:
        raise errors[0]


@cache
def _openmp() -> ctypes.CDLL | None:
    """The OpenMP runtime that torch has loaded, None where it is another kind or out of sight."""
    library = ctypes.CDLL(None)
    try:
        library.GOMP_parallel.argtypes = [_Region, ctypes.c_void_p, ctypes.c_uint, ctypes.c_uint]
        library.GOMP_parallel.restype = None
        library.omp_get_thread_num.argtypes = library.omp_get_num_threads.argtypes = []
    except AttributeError:
        return None
    return library


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(thread_name_prefix="rows")
