"""Where a result comes from: commit and uncommitted changes, package versions, hardware."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

PACKAGES = ("attentionvote", "torch", "lightning", "mlflow", "numpy", "scipy", "hydra-core", "mujoco-core", "trimesh")
PATCH_LIMIT_BYTES = 1_000_000


@dataclass(frozen=True)
class GitState:
    """State of the working tree: commit (or "unknown"), `git status` lines, and the patch of tracked files."""

    commit: str
    status: str
    patch: str

    @property
    def is_dirty(self) -> bool:
        """Whether the work tree differs from the commit."""
        return bool(self.status)

    @property
    def label(self) -> str:
        """The commit, with ``+dirty`` behind it when the work tree differs: what a model's card says."""
        return f"{self.commit}+dirty" if self.is_dirty else self.commit


def _git(folder: Path, *arguments: str, limit: int | None = None) -> str:
    command = ["git", "-C", str(folder), "--no-optional-locks", "-c", "core.quotepath=off", *arguments]
    try:
        result = subprocess.run(command, capture_output=True, timeout=20, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    text = result.stdout
    if limit is not None and len(text) > limit:
        cut = f"\n[cut: {len(text)} bytes, the first {limit} are kept]\n"
        return text[:limit].decode("utf-8", errors="ignore") + cut
    return text.decode("utf-8", errors="replace")


def git_state(folder: Path, patch_limit: int = PATCH_LIMIT_BYTES) -> GitState:
    """The working tree that ``folder`` lies in; everything empty and commit "unknown" outside of one.

    Untracked files appear in ``status`` by name only; the patch is cut at ``patch_limit`` bytes and says so.
    """
    commit = _git(folder, "rev-parse", "HEAD").strip()
    if not commit:
        return GitState("unknown", "", "")
    # The content of changed binary files says nothing to a reader, their names are in the status.
    return GitState(
        commit, _git(folder, "status", "--porcelain", limit=100_000), _git(folder, "diff", "HEAD", limit=patch_limit)
    )


def package_versions() -> dict[str, str]:
    """Versions of Python and of the packages that decide a result; absent ones are left out."""
    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions


def _cpu_model() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def gpu_names() -> list[str]:
    """Names of the NVIDIA GPUs, from the driver's own tool (asking torch would start CUDA)."""
    rows = query_gpus("name")
    return [row[0] for row in rows]


def query_gpus(fields: str) -> list[list[str]]:
    """One row of values per GPU of ``nvidia-smi --query-gpu=fields``; empty without a GPU."""
    if shutil.which("nvidia-smi") is None:
        return []
    command = ["nvidia-smi", f"--query-gpu={fields}", "--format=csv,noheader,nounits"]
    try:
        text = subprocess.run(command, capture_output=True, timeout=10, check=True, text=True).stdout
    except (OSError, subprocess.SubprocessError):
        return []
    return [[cell.strip() for cell in line.split(",")] for line in text.splitlines() if line.strip()]


def hardware() -> dict[str, str]:
    """Processor, usable cores, memory in GiB and GPUs, as short texts."""
    import psutil

    return {
        "cpu": _cpu_model(),
        "cores": str(len(os.sched_getaffinity(0))) if hasattr(os, "sched_getaffinity") else str(os.cpu_count()),
        "memory_gib": f"{psutil.virtual_memory().total / 2**30:.1f}",
        "gpu": ", ".join(gpu_names()) or "none",
        "host": platform.node(),
        "system": f"{platform.system()} {platform.release()}",
    }


def command_line() -> str:
    """How the process was started."""
    return " ".join(sys.argv)
