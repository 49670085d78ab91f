"""Provenance of a result: commit and uncommitted changes, package versions, hardware."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from attentionvote.execution.hardware import cores

PACKAGES = ("attentionvote", "torch", "lightning", "mlflow", "numpy", "scipy", "hydra-core", "mujoco-core", "trimesh")
PATCH_LIMIT_BYTES = 1_000_000
_PLACES = ("index", "objects")
# As `git apply` wants it, whatever the user's own settings say.
_PLAIN = ("--no-color", "--no-ext-diff", "--no-textconv", "--src-prefix=a/", "--dst-prefix=b/")


@dataclass(frozen=True)
class GitState:
    """State of the working tree.

    Attributes:
        commit: checked out, or "unknown".
        status: lines of `git status`.
        patch: from the commit to the working tree, new files included; changed binary files by the hash of their blob.
        is_whole: whether the patch holds every change.
    """

    commit: str
    status: str
    patch: str
    is_whole: bool = True

    @property
    def is_dirty(self) -> bool:
        """Whether the work tree differs from the commit."""
        return bool(self.status)

    @property
    def label(self) -> str:
        """The commit, with ``+dirty`` behind it when the work tree differs: what a model's card says."""
        return f"{self.commit}+dirty" if self.is_dirty else self.commit

    @property
    def patch_digest(self) -> str:
        """Sha256 of the patch; empty when there are no changes or it does not hold all of them."""
        return hashlib.sha256(self.patch.encode()).hexdigest() if self.is_dirty and self.is_whole else ""


def _git(folder: Path, *arguments: str, environment: Mapping[str, str] | None = None) -> bytes | None:
    """What git prints; None when it fails."""
    command = ["git", "-C", str(folder), "--no-optional-locks", "-c", "core.quotepath=off", *arguments]
    try:
        return subprocess.run(
            command, capture_output=True, timeout=20, check=True, env={**os.environ, **(environment or {})}
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return None


def git_state(folder: Path, patch_limit: int = PATCH_LIMIT_BYTES) -> GitState:
    """The working tree that ``folder`` lies in; everything empty and commit "unknown" outside of one.

    The patch is cut at ``patch_limit`` bytes and says so.
    """
    commit = (_git(folder, "rev-parse", "HEAD") or b"").decode().strip()
    if not commit:
        return GitState("unknown", "", "")
    listing = _git(folder, "status", "--porcelain", "--untracked-files=all")
    if listing == b"":
        return GitState(commit, "", "")
    status = "unknown\n" if listing is None else listing[:100_000].decode(errors="replace")
    changes = _changes(folder)
    whole = bool(changes) and len(changes or b"") <= patch_limit and _is_text(changes or b"")
    changes = changes if changes is not None else _git(folder, "diff", *_PLAIN, "HEAD") or b""
    if len(changes) <= patch_limit:
        return GitState(commit, status, changes.decode(errors="replace"), whole)
    cut = f"\n[cut: {len(changes)} bytes, the first {patch_limit} are kept]\n"
    return GitState(commit, status, changes[:patch_limit].decode(errors="ignore") + cut, False)


def _changes(folder: Path) -> bytes | None:
    """The patch with new files; None when git cannot make it in time.

    Staged into an index and objects of its own, so that the user's repository is only read.
    """
    index, objects = ((_git(folder, "rev-parse", "--git-path", name) or b"").decode().strip() for name in _PLACES)
    with tempfile.TemporaryDirectory(prefix="attentionvote-") as scratch:
        environment = {"GIT_INDEX_FILE": f"{scratch}/index", "GIT_OBJECT_DIRECTORY": f"{scratch}/objects"}
        environment["GIT_ALTERNATE_OBJECT_DIRECTORIES"] = str((folder / objects).resolve())
        try:
            Path(environment["GIT_OBJECT_DIRECTORY"]).mkdir()
            # With its time: by it git knows which files may have changed within the second it was written in.
            shutil.copy2(folder / index, environment["GIT_INDEX_FILE"])
        except OSError:
            return None
        if _git(folder, "add", "--all", environment=environment) is None:
            return None
        return _git(folder, "diff", *_PLAIN, "--cached", "--full-index", "HEAD", environment=environment)


def _is_text(patch: bytes) -> bool:
    """Whether a patch is what it was after it has been a text."""
    try:
        patch.decode()
    except UnicodeDecodeError:
        return False
    return True


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
        "cores": str(cores()),
        "memory_gib": f"{psutil.virtual_memory().total / 2**30:.1f}",
        "gpu": ", ".join(gpu_names()) or "none",
        "host": platform.node(),
        "system": f"{platform.system()} {platform.release()}",
    }


def command_line() -> str:
    """How the process was started, as a shell takes it."""
    return shlex.join(sys.argv)
