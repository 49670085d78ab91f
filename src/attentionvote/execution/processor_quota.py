"""The processor time that control groups leave to a process: containers, Kubernetes, systemd, Slurm.

A process lies in one group of every hierarchy that is mounted: of the one of version 2, of one for each controller of
version 1, or of both kinds (hybrid). Every group above its own may have a quota too, and the smallest counts. Inside a
container the groups above its own cannot be seen; what is seen there as the root has the container's quota.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath


@dataclass(frozen=True)
class _Hierarchy:
    """A mounted hierarchy that may limit the processor.

    Attributes:
        version: of the control groups, 1 or 2.
        folder: where it is mounted.
        root: path, within the hierarchy, of the group that is seen there.
    """

    version: int
    folder: Path
    root: PurePosixPath


def processor_quota(proc: Path = Path("/proc/self"), system: Path = Path("/")) -> float:
    """Cores' worth of time that the process may use in each period; infinite without a quota.

    Args:
        proc: the process's folder, with ``cgroup`` and ``mountinfo``.
        system: what the mount points are below.
    """
    groups = _groups(proc)
    quotas = [
        _quota(folder, hierarchy.version)
        for hierarchy in _hierarchies(proc, system)
        for folder in _folders(hierarchy, groups.get(hierarchy.version, PurePosixPath("/")))
    ]
    return min(quotas, default=math.inf)


def _groups(proc: Path) -> dict[int, PurePosixPath]:
    """The process's group by version; lines are ``0::/path`` (2) and ``4:cpu,cpuacct:/path`` (1)."""
    groups = {}
    for line in _lines(proc / "cgroup"):
        _, controllers, path = line.split(":", 2)
        if not controllers:
            groups[2] = PurePosixPath(path)
        elif "cpu" in controllers.split(","):
            groups[1] = PurePosixPath(path)
    return groups


def _hierarchies(proc: Path, system: Path) -> Iterator[_Hierarchy]:
    """Those of version 2, and those of version 1 with the controller ``cpu``."""
    for line in _lines(proc / "mountinfo"):
        place, _, kind = line.partition(" - ")
        _, _, _, root, folder, *_ = place.split(" ")
        system_type, _, options = kind.split(" ", 2)
        version = {"cgroup": 1, "cgroup2": 2}.get(system_type)
        if version is None or (version == 1 and "cpu" not in options.split(",")):
            continue
        yield _Hierarchy(version, system / _unescaped(folder).lstrip("/"), PurePosixPath(_unescaped(root)))


def _folders(hierarchy: _Hierarchy, group: PurePosixPath) -> Iterator[Path]:
    """Folders of the group and of all above it, as far as they can be seen."""
    yield hierarchy.folder
    # The mount may show only a part of the hierarchy; where the group's path does not lie in it (a namespace of its
    # own counts from another root), the path may still be one below the mount.
    inside = group.relative_to(hierarchy.root) if group.is_relative_to(hierarchy.root) else group.relative_to("/")
    if ".." in inside.parts:
        return  # a group outside of what is seen
    folder = hierarchy.folder
    for name in inside.parts:
        folder = folder / name
        yield folder


def _quota(folder: Path, version: int) -> float:
    """Cores of one group; infinite without a quota or without a file that says it."""
    try:
        if version == 2:
            quota, period = (folder / "cpu.max").read_text().split()
        else:
            quota, period = ((folder / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period"))
        cores = int(quota) / int(period)
    except (OSError, ValueError, ZeroDivisionError):  # no such file, or "max"
        return math.inf
    return cores if cores > 0 else math.inf  # -1: no quota


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text().splitlines()
    except OSError:  # no /proc
        return []


def _unescaped(path: str) -> str:
    """A path of mountinfo, where blanks are octal numbers."""
    return re.sub(r"\\([0-7]{3})", lambda number: chr(int(number[1], 8)), path)
