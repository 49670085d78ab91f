"""LZF, the compression of PCD files.

A control byte below 32 is followed by that many plus one literal bytes. Any other one repeats bytes written before:
its upper three bits plus two are how many (7: another byte is added to them), its lower five bits and the next byte
are how far back, minus one. ``scan_bytes.c`` does it where it is compiled, Python elsewhere; both return the same.
"""

from __future__ import annotations

import ctypes

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry import native
from attentionvote.inference.scans.limits import BLOCK_BYTES, Budget

_MOST_RATIO = 88  # three bytes repeat 264
_EARLY_END, _BEFORE_BEGINNING = 1, 2
_TOKENS = 4096  # between two looks at the clock


def decompressed(packed: memoryview | bytes, size: int, budget: Budget) -> NDArray[np.uint8]:
    """The first ``size`` bytes of what is packed.

    Raises:
        ValueError: when the data end early, refer to something before their beginning, or cost more than the budget.
    """
    if size > _MOST_RATIO * len(packed):
        raise ValueError("its compressed points end early: it is truncated")
    budget.take(size)
    library = native.load("attentionvote.inference.scans", "scan_bytes.c", make=False)
    if library is None:
        return np.frombuffer(_by_python(packed, size, budget), np.uint8)
    return _by_c(library, packed, size, budget)


def _by_c(library: ctypes.CDLL, packed: memoryview | bytes, size: int, budget: Budget) -> NDArray[np.uint8]:
    source, out = np.frombuffer(packed, np.uint8), np.empty(size, np.uint8)
    state = np.zeros(5, np.int64)
    long = native.long
    while state[1] < size:
        stop = int(state[1]) + BLOCK_BYTES
        native.call(library.lzf_block, source, long(len(source)), out, long(size), long(stop), state)
        if state[2] == _EARLY_END:
            raise ValueError("its compressed points end early: it is truncated")
        if state[2] == _BEFORE_BEGINNING:
            raise ValueError("its compressed points are damaged")
        budget.check_time()
    return out


def _by_python(packed: memoryview | bytes, size: int, budget: Budget) -> bytearray:
    out = bytearray()
    at, end, tokens = 0, len(packed), 0
    try:
        while len(out) < size:
            tokens += 1
            if tokens % _TOKENS == 0:
                budget.check_time()
            control = packed[at]
            at += 1
            if control < 32:
                if at + control >= end:
                    raise IndexError
                out += packed[at : at + control + 1]
                at += control + 1
                continue
            count = control >> 5
            if count == 7:
                count += packed[at]
                at += 1
            count += 2
            back = ((control & 31) << 8 | packed[at]) + 1
            at += 1
            start = len(out) - back
            if start < 0:
                raise ValueError("its compressed points are damaged")
            if back >= count:
                out += out[start : start + count]
            else:  # it repeats what it is writing
                out += (out[start:] * (count // back + 1))[:count]
    except IndexError as error:
        raise ValueError("its compressed points end early: it is truncated") from error
    del out[size:]
    return out
