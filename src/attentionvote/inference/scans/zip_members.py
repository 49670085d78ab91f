"""Members of a zip archive, stored or deflated: its directory is measured before it is read, no size is believed."""

from __future__ import annotations

import struct
import zlib
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.inference.scans.limits import BLOCK_BYTES, MOST_ARRAYS, Budget

ZIP_MAGIC = b"PK\x03\x04"
_ENTRY_MAGIC, _END_MAGIC, _LONG_END_MAGIC = b"PK\x01\x02", b"PK\x05\x06", b"PK\x06\x07"
_END, _ENTRY, _LOCAL = struct.Struct("<4s4H2IH"), struct.Struct("<4s6H3I5H2I"), struct.Struct("<4s5H3I2H")
_MOST_COMMENT_BYTES, _MOST_NAME_BYTES = 65_535, 1024
_STORED, _DEFLATED = 0, 8
_METHODS = {9: "Deflate64", 12: "bzip2", 14: "LZMA", 93: "Zstandard", 95: "XZ"}
_MOST_RATIO = 1032  # of Deflate: two bits repeat 258
_DAMAGED = "it is no .npz archive, or damaged"


class ZipMember(NamedTuple):
    """An entry of an archive's directory.

    Attributes:
        flags, method: of its packing.
        checksum: CRC-32 of the unpacked bytes.
        packed, size: bytes in the archive, and unpacked.
        offset: of its local header.
    """

    flags: int
    method: int
    checksum: int
    packed: int
    size: int
    offset: int


def zip_members(content: memoryview) -> dict[str, ZipMember]:
    """The members of an archive by name.

    Raises:
        ValueError: with what is wrong, when it is no archive, has too many members or two of the same name.
    """
    at = bytes(content[-_END.size - _MOST_COMMENT_BYTES :]).rfind(_END_MAGIC)
    end = at + max(len(content) - _END.size - _MOST_COMMENT_BYTES, 0)
    if at < 0 or end + _END.size > len(content):
        raise ValueError(_DAMAGED)
    _, disk, first_disk, here, count, size, start, _ = _END.unpack_from(content, end)
    if bytes(content[max(end - 20, 0) : end])[:4] == _LONG_END_MAGIC or count == 0xFFFF:
        raise ValueError("it must be a plain zip archive, got one of the 64-bit kind: write it with numpy.savez")
    if count > MOST_ARRAYS:
        raise ValueError(f"it must have at most {MOST_ARRAYS} arrays, got {count}")
    if disk or first_disk or here != count or start + size != end:
        raise ValueError(_DAMAGED)
    return _entries(content[start:end], count)


def _entries(directory: memoryview, count: int) -> dict[str, ZipMember]:
    members: dict[str, ZipMember] = {}
    at = 0
    for _ in range(count):
        if at + _ENTRY.size > len(directory):
            raise ValueError(_DAMAGED)
        magic, _, _, flags, method, _, _, checksum, packed, size, *lengths, _, _, _, offset = _ENTRY.unpack_from(
            directory, at
        )
        name_bytes, extra_bytes, comment_bytes = lengths
        if magic != _ENTRY_MAGIC or name_bytes > _MOST_NAME_BYTES:
            raise ValueError(_DAMAGED)
        at += _ENTRY.size
        name = bytes(directory[at : at + name_bytes]).decode("utf-8", "replace")
        if name in members:
            raise ValueError(f"its archive must hold each array once, got {name[:60]!r} twice")
        members[name] = ZipMember(flags, method, checksum, packed, size, offset)
        at += name_bytes + extra_bytes + comment_bytes
    if at != len(directory):
        raise ValueError(_DAMAGED)
    return members


def unpacked(content: memoryview, member: ZipMember, budget: Budget) -> memoryview:
    """The bytes of a member; of a stored one they are not copied.

    Raises:
        ValueError: with what is wrong, when it is damaged, packed in another way, or more than the budget allows.
    """
    if member.flags & 1:
        raise ValueError("its arrays must not be encrypted: write it with numpy.savez")
    if member.method not in (_STORED, _DEFLATED):
        method = _METHODS.get(member.method, "another method")
        raise ValueError(f"its arrays must be stored or deflated, got {method}: write it with numpy.savez_compressed")
    packed = _packed(content, member)
    if member.method == _STORED:
        if len(packed) != member.size:
            raise ValueError(_DAMAGED)
        data = packed
    else:
        data = memoryview(_inflated(packed, member.size, budget).data)
    checksum = 0
    for start in range(0, len(data), BLOCK_BYTES):
        budget.check_time()
        checksum = zlib.crc32(data[start : start + BLOCK_BYTES], checksum)
    if checksum != member.checksum:
        raise ValueError(_DAMAGED)
    return data


def _packed(content: memoryview, member: ZipMember) -> memoryview:
    """What lies in the archive behind a member's local header."""
    if member.offset + _LOCAL.size > len(content):
        raise ValueError(_DAMAGED)
    magic, *_, name_bytes, extra_bytes = _LOCAL.unpack_from(content, member.offset)
    start = member.offset + _LOCAL.size + name_bytes + extra_bytes
    if magic != ZIP_MAGIC or start + member.packed > len(content):
        raise ValueError(_DAMAGED)
    return content[start : start + member.packed]


def _inflated(packed: memoryview, size: int, budget: Budget) -> NDArray[np.uint8]:
    """Exactly ``size`` bytes; the directory that says so is not believed, but data of another length are damaged."""
    if size > _MOST_RATIO * len(packed) + _MOST_RATIO:
        raise ValueError(_DAMAGED)
    budget.take(size)
    out = np.empty(size, np.uint8)
    stream, done = zlib.decompressobj(-zlib.MAX_WBITS), 0
    try:
        for start in range(0, len(packed), BLOCK_BYTES // 4):
            piece: bytes | memoryview = packed[start : start + BLOCK_BYTES // 4]
            while len(piece):
                budget.check_time()
                # One byte beyond the size, so that data which go on are noticed.
                block = stream.decompress(piece, min(size - done + 1, BLOCK_BYTES))
                if done + len(block) > size:
                    raise ValueError(_DAMAGED)
                out[done : done + len(block)] = np.frombuffer(block, np.uint8)
                done += len(block)
                piece = stream.unconsumed_tail
            if stream.eof:  # what follows would only be collected
                break
    except zlib.error as error:
        raise ValueError(_DAMAGED) from error
    if done != size or not stream.eof:
        raise ValueError(_DAMAGED)
    return out
