"""Generated scenes in layouts that other people's tools read: the Fraunhofer IPA dataset's, and BOP's."""

from __future__ import annotations

import logging
import os
import shutil
import time
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attentionvote.command.entry import configuring
from attentionvote.command.errors import ConfigurationError
from attentionvote.execution.hardware import cores
from attentionvote.files import naming_full_disk, read_json, write_json
from attentionvote.workflows.settings import WriteDataSettings

if TYPE_CHECKING:
    from attentionvote.datasets import PinholeCamera
    from attentionvote.part import Parts
    from attentionvote.simulation.camera import Camera
    from attentionvote.simulation.raycast import PartCaster
    from attentionvote.simulation.scene_record import SceneRecord

log = logging.getLogger("attentionvote.write_data")
IPA_SPLITS = {"train": "training", "val": "validation", "test": "testing"}


def run(cfg: WriteDataSettings) -> dict[str, Any]:
    """Generate what is missing, write it; where it is and how much."""

    from attentionvote.datasets.dataset import RECEIPT
    from attentionvote.datasets.ipa_writer import big_picture
    from attentionvote.part import only_part
    from attentionvote.simulation.raycast import PartCaster
    from attentionvote.simulation.scene_set import generate_scene_set
    from attentionvote.simulation.scene_spec import scene_set_directory, scene_set_specs

    start = time.monotonic()
    with configuring(f"object {cfg.object.name}"):
        parts = cfg.object()
        if cfg.format == "ipa":
            only_part(parts, "format=ipa")
    with configuring():
        specs = scene_set_specs(parts, cfg.simulation)
        if cfg.split not in specs:
            raise ConfigurationError(f"split must be one of {', '.join(specs)}; got {cfg.split!r}")
        spec = specs[cfg.split]
        if cfg.format == "ipa":
            big_picture(pinhole(spec.camera.camera))
    layout = Path(cfg.directory) / cfg.format
    target = layout / IPA_SPLITS[cfg.split] / parts.name if cfg.format == "ipa" else layout / parts.name / cfg.split
    with configuring():
        if cfg.format == "bop":
            write_bop_models(layout / parts.name, parts)
    scene_set = generate_scene_set(
        parts, spec, scene_set_directory(Path(cfg.root), parts.name, spec), cfg.workers or cores()
    )
    records = scene_set.records[: cfg.scenes]
    receipt = {"format": cfg.format, "scene_set": scene_set.digest, "part": parts.digest, "scenes": len(records)}
    result = {"stage": "write_data", "object": parts.name, "directory": str(target), **receipt}
    if target.exists():
        if read_json(target / RECEIPT) != receipt:
            raise ConfigurationError(f"directory must not hold other data, but {target} is there: choose another")
        log.info("%s holds these scenes already", target)
        return result
    write = write_ipa if cfg.format == "ipa" else write_bop
    temporary = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        with naming_full_disk(target.parent):
            write(temporary, PartCaster(parts), records, lambda done: _say(done, len(records)))
            write_json(temporary / RECEIPT, receipt)
            temporary.replace(target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    log.info("%d scenes in %s; `make check-data DIR=%s` looks at them", len(records), target, target)
    return {**result, "seconds": round(time.monotonic() - start, 1)}


def pinhole(camera: Camera) -> PinholeCamera:
    """A simulated camera as the datasets have it."""
    from attentionvote.datasets import PinholeCamera

    return PinholeCamera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)


def write_ipa(folder: Path, caster: PartCaster, records: Sequence[SceneRecord], report: Callable[[int], None]) -> None:
    """Write scenes in the IPA layout.

    A cycle has one picture of its empty bin there, from which readers tell the parts. When the camera moves from scene
    to scene no such picture exists: the bin is left out of every depth then, and the empty picture is empty.
    """
    import numpy as np

    from attentionvote.datasets.ipa_writer import IpaWriter
    from attentionvote.simulation.depth_pictures import camera_stands_still, depth_and_owner, depth_range

    with_bin = camera_stands_still(records)
    if not with_bin:
        log.info("the camera of this set moves from scene to scene: the bin is left out of the depth")
    radius = max(float(np.linalg.norm(part.vertices, axis=1).max()) for part in caster.part.parts)
    writer = IpaWriter(folder, caster.part.name, pinhole(records[0].camera), *depth_range(records, radius))
    begun: set[int] = set()
    for done, record in enumerate(records):
        truth = record.camera_from_part, record.visible_fraction
        scenes = [(depth_and_owner(record, caster), truth)]
        if record.cycle not in begun:
            begun.add(record.cycle)
            scenes.insert(0, (depth_and_owner(record, caster, parts=False), (truth[0][:0], truth[1][:0])))
        for (depth, owner), (poses, visible) in scenes:
            shown = depth if with_bin else np.where(owner >= 0, depth, np.nan)
            writer.write(record.cycle, shown, owner, poses, visible, record.camera_from_bin)
        report(done + 1)


def write_bop(folder: Path, caster: PartCaster, records: Sequence[SceneRecord], report: Callable[[int], None]) -> None:
    """Write scenes as BOP: a scene a drop cycle, a picture a pile; object ids count from 1 in the set's order."""

    from attentionvote.datasets.bop_writer import BopSceneWriter
    from attentionvote.simulation.depth_pictures import depth_and_owner, silhouettes

    done = 0
    for cycle, piles in groupby(records, key=lambda record: record.cycle):
        writer = BopSceneWriter(folder / f"{cycle:06d}")
        for image, record in enumerate(piles):
            depth, owner = depth_and_owner(record, caster)
            alone = silhouettes(record, caster)
            ids = (record.part_ids + 1).tolist()
            poses, visible = record.camera_from_part, record.visible_fraction
            writer.write(image, pinhole(record.camera), depth, owner, alone, poses, visible, ids)
            done += 1
            report(done)
        writer.finish()


def write_bop_models(folder: Path, parts: Parts) -> None:
    """Write the models beside the splits; what is there must be the same.

    Raises:
        ValueError: when the folder holds models of other parts.
    """
    from attentionvote.datasets.bop_models import MODELS_INFO
    from attentionvote.datasets.bop_writer import write_models

    temporary, target = folder / f".models.{os.getpid()}", folder / "models"
    try:
        write_models(temporary, {index + 1: part for index, part in enumerate(parts.parts)})
        if not target.exists():
            temporary.replace(target)
        elif (target / MODELS_INFO).read_bytes() != (temporary / MODELS_INFO).read_bytes():
            raise ValueError(f"directory must not hold models of other parts, but {target} does: choose another")
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _say(done: int, of: int) -> None:
    if done % 20 == 0 or done == of:
        log.info("%d of %d scenes", done, of)
