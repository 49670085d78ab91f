"""LZF, the compression of PCD files.

A control byte below 32 is followed by that many plus one literal bytes. Any other one repeats bytes written before:
its upper three bits plus two are how many (7: another byte is added to them), its lower five bits and the next byte
are how far back, minus one.
"""

from __future__ import annotations


def decompressed(packed: bytes, size: int) -> bytearray:
    """The first ``size`` bytes of what is packed.

    Raises:
        ValueError: when the data end early or refer to something before their beginning.
    """
    out = bytearray()
    at, end = 0, len(packed)
    try:
        while len(out) < size:
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
    return out[:size]
