"""What killed processes left: temporary files of ``files.whole``, drafts of bundles, half removed folders."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

from attentionvote.files import REMOVED, is_locked

_LEAST_AGE_S = 3600  # nobody writes one file for so long
_TEMPORARY = re.compile(r"\..+\.\d+(\.\w+)?")  # .STEM.PID.SUFFIX
_DRAFTS = (".writing-bundle", ".old-bundle", ".writing-link")
_ARTEFACTS = "mlartifacts"


def leftovers(roots: list[Path], now_s: float) -> Iterator[Path]:
    """Files and folders below some folders that a killed process left.

    Args:
        roots: where data and results lie.
        now_s: the time, seconds since 1970.
    """
    for root in roots:
        for folder, folders, files in os.walk(root):
            path = Path(folder)
            folders[:] = sorted(name for name in folders if name != _ARTEFACTS and not (path / name).is_symlink())
            remains = [name for name in folders if name.startswith(REMOVED) or name in _DRAFTS]
            folders[:] = [name for name in folders if name not in remains]
            remains += [name for name in files if _TEMPORARY.fullmatch(name) or name in _DRAFTS]
            for name in sorted(remains):
                if is_leftover(path / name, now_s):
                    yield path / name


def is_leftover(path: Path, now_s: float) -> bool:
    """Whether nobody is at it any more: it is old enough, and neither it nor a folder above it is locked."""
    try:
        old = path.name.startswith(REMOVED) or now_s - path.lstat().st_mtime > _LEAST_AGE_S
    except FileNotFoundError:
        return False
    return old and not any(is_locked(folder) for folder in [path, *path.parents[:3]])
