"""The removal of what nobody refers to: each thing under its lock, whole or not at all."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Sequence
from pathlib import Path

from attentionvote.files import FolderUnavailable, is_locked, locked_folder, read_json, remove_folder
from attentionvote.workflows.prune.findings import KINDS, Unreferenced
from attentionvote.workflows.prune.holdings import BundleFolder, Holdings
from attentionvote.workflows.prune.leftovers import is_leftover
from attentionvote.workflows.prune.settings import PruneSettings
from attentionvote.workflows.train.job import RESULT

log = logging.getLogger("attentionvote.prune")
# What says that a thing is complete.
_FIRST = {"training": (RESULT,), "scenes": ("manifest.json",), "clouds": ("count.npy",)}


class InUse(Exception):
    """Something that is to be removed is in use by now; one sentence."""


def remove_part(cfg: PruneSettings, part: str, things: Sequence[Unreferenced]) -> set[Path]:
    """Remove things of one part, first what refers to others; what is gone.

    A process that came meanwhile ends it with a warning: what is left of the part stays, because that process may
    need it.

    Args:
        cfg: where things lie.
        part: its name.
        things: to be removed.

    Raises:
        OSError: when something cannot be removed.
    """
    gone: set[Path] = set()
    try:
        for thing in sorted(things, key=lambda thing: KINDS.index(thing.kind)):
            _remove(cfg, thing)
            gone.add(thing.path)
    except (InUse, FolderUnavailable) as error:
        log.warning("%d of %d things of %s stay: %s", len(things) - len(gone), len(things), part, error)
    return gone


def _remove(cfg: PruneSettings, thing: Unreferenced) -> None:
    path = thing.path
    if thing.kind == "leftover":
        if is_leftover(path, time.time()):
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink(missing_ok=True)
        return
    if not path.is_dir():
        return
    if thing.kind == "bundle":
        with locked_folder(path.parent, cfg.outputs, "part's export"):
            if BundleFolder(path).is_latest:
                raise InUse(f"{path} is the latest bundle by now")
            for record in path.parent.glob("export-*.json"):
                if Path(str((read_json(record) or {}).get("bundle"))).name == path.name:
                    record.unlink()
            remove_folder(path)
        return
    busy: Path | None = Path(cfg.outputs) / "export" / thing.part
    if thing.kind != "training":
        busy = Holdings.below([Path(cfg.outputs), *map(Path, cfg.also)]).busy(thing.part)
    if busy is not None and is_locked(busy):
        raise InUse(f"a process is at {busy} by now")
    with locked_folder(path.parent if thing.kind == "checkpoints" else path, cfg.outputs, thing.kind):
        remove_folder(path, *_FIRST.get(thing.kind, ()))
