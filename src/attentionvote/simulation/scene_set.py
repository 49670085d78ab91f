"""Scene sets: many drop cycles, one file each, the same bits from the same specification.

A set's directory holds ``manifest.json`` (specification and, once complete, the digest of the content), ``hulls.npz``
(so that a continued set uses the same convex pieces) and ``cycles/00000.npz``.... Every cycle has its own seed, drawn
from (seed, split, cycle): neither the number of workers nor an interruption changes anything, and no cycle of one split
occurs in another.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from attentionvote.execution import Executor
from attentionvote.files import waiting_lock, whole, write_json
from attentionvote.part import Parts
from attentionvote.simulation.cycle import simulate_cycle, solids_of
from attentionvote.simulation.cycle_pool import run_cycles
from attentionvote.simulation.drop import Solid
from attentionvote.simulation.raycast import PartCaster
from attentionvote.simulation.scene_record import SceneRecord, load_records, save_records
from attentionvote.simulation.scene_spec import SceneSetSpec

log = logging.getLogger("attentionvote.view")


@dataclass(frozen=True, eq=False)
class SceneSet:
    """A complete scene set on disk; ``digest`` identifies its content, ``spec_digest`` its specification."""

    directory: Path
    digest: str
    spec_digest: str
    cycles: int

    @staticmethod
    def is_complete(directory: Path) -> bool:
        """Whether ``directory`` holds a complete set."""
        manifest = _read_manifest(directory)
        return manifest is not None and manifest["content_digest"] is not None

    @classmethod
    def open(cls, directory: Path) -> SceneSet:
        """Open the set in ``directory``.

        Raises:
            ValueError: when there is none, or it is not complete.
        """
        manifest = _read_manifest(directory)
        if manifest is None:
            raise ValueError(
                f"{directory} must hold a scene set, but it has no manifest.json: run `make generate` first"
            )
        if manifest["content_digest"] is None:
            raise ValueError(f"{directory} must hold a complete scene set, but it was interrupted: run `make generate`")
        return cls(directory, manifest["content_digest"], manifest["spec_digest"], manifest["spec"]["cycles"])

    @cached_property
    def records(self) -> Sequence[SceneRecord]:
        """All scenes, cycle by cycle, fewest parts first."""
        return [record for cycle in range(self.cycles) for record in load_records(_shard(self.directory, cycle))]

    @property
    def cell_volume(self) -> tuple[float, float, float] | None:
        """Where a bin with walls and a given distance lies: depth of its rim at the least distance that is drawn, of
        its floor at the largest, and its longest side, metres; None where the lengths scale with D."""
        spec = json.loads((self.directory / "manifest.json").read_text())["spec"]
        size, distance = spec["bin"]["size"], spec["camera"]["distance"]
        if not spec["bin"].get("walls") or size is None or distance is None:
            return None
        jitter = spec["camera"]["distance_jitter"]
        # The camera looks at a point a third up the bin's axis.
        near, far = distance * (1 - jitter) - size[2] * 2 / 3, distance * (1 + jitter) + size[2] / 3
        return max(near, 0.01), far, max(size) * (1 + spec["bin"]["jitter"])

    @property
    def cycle_of_scene(self) -> NDArray[np.int64]:
        """``(S,)`` which drop cycle each scene is of."""
        return np.array([record.cycle for record in self.records], dtype=np.int64)

    def __len__(self) -> int:
        return len(self.records)

    def __iter__(self) -> Iterator[SceneRecord]:
        return iter(self.records)


def generate_scene_set(
    part: Parts,
    spec: SceneSetSpec,
    directory: Path,
    workers: int = 1,
    progress: bool = True,
    executor: Executor | None = None,
) -> SceneSet:
    """Generate what is missing of a scene set and open it; does nothing when it is complete.

    Args:
        part: the part or set of parts; its digest must be the specification's.
        spec: what to generate.
        directory: the set's own directory, created when missing; a second process waits for the first.
        workers: processes; the result does not depend on it.
        progress: show a progress bar with the time left on stderr.
        executor: where the workers are; default this machine. Nor does the result depend on it.

    Raises:
        ValueError: when the directory holds another set or the part is another one, or the executor cannot work here.
        FolderUnavailable: when something is missing and the directory cannot be written.
        OSError: when the worker of one cycle died again and again, or the disk is full; what is finished is kept and
            the next call goes on from there.
    """
    if part.digest != spec.part_digest:
        raise ValueError(
            f"{part.name}: the scene set is specified for part {spec.part_digest[:12]}, this is {part.digest[:12]}"
        )
    if workers < 1:
        raise ValueError(f"workers must be at least 1, got {workers}")
    if _is_complete(directory, spec):  # nothing is written, not even the lock: it may be a place for reading only
        return SceneSet.open(directory)
    with waiting_lock(directory / ".lock"):
        if not _is_complete(directory, spec):  # another process may have been at it
            manifest = _read_manifest(directory)
            (directory / "cycles").mkdir(exist_ok=True)
            for leftover in [*directory.glob(".*.*.*"), *directory.glob("cycles/.*")]:
                leftover.unlink()  # temporary files of a killed process; the lock says nobody writes now
            if manifest is None:
                _write_manifest(directory, part, spec, None)
            solids = _frozen_solids(part, spec, directory)
            missing = [c for c in range(spec.cycles) if not _shard(directory, c).is_file()]
            title = f"{part.name}, {spec.split} scenes"
            done = spec.cycles - len(missing)
            for cycle, records in run_cycles(part, solids, spec, missing, workers, progress, title, done, executor):
                save_records(_shard(directory, cycle), records)
            _write_manifest(directory, part, spec, content_digest(directory, spec.cycles))
    scenes = SceneSet.open(directory)
    if len(scenes.records) < spec.scenes / 2:
        log.warning(
            "%s, %s scenes: %d of %d piles came of it, because the bin was full before; a higher or wider bin has room",
            part.name, spec.split, len(scenes.records), spec.scenes,
        )  # fmt: skip
    return scenes


def _is_complete(directory: Path, spec: SceneSetSpec) -> bool:
    """Whether the set of this specification is there whole; its manifest comes last.

    Raises:
        ValueError: when the directory holds another set.
    """
    manifest = _read_manifest(directory)
    if manifest is None:
        return False
    if manifest["spec_digest"] != spec.digest():
        raise ValueError(
            f"{directory} holds scene set {manifest['spec_digest'][:12]}, but {spec.digest()[:12]} was asked for: "
            "choose another directory"
        )
    return manifest["content_digest"] is not None


def content_digest(directory: Path, cycles: int) -> str:
    """Sha256 over all scenes: poses to 1 micrometre and 1e-6 in the rotation matrix, visibility to 1e-4.

    Rounding hides differences of the last bits; a machine whose arithmetic leads to another pile gives another digest,
    as it should: it is other data.
    """
    h = hashlib.sha256()
    for cycle in range(cycles):
        for r in load_records(_shard(directory, cycle)):
            h.update(f"{r.cycle} {r.drop_count} {r.camera} {r.scene_seed}".encode())
            for values, scale in (
                (r.camera_from_part, 1e6),
                (r.camera_from_bin, 1e6),
                (r.bin_size, 1e6),
                (r.visible_fraction, 1e4),
            ):
                h.update(np.round(values * scale).astype("<i8").tobytes())
            if r.part_ids.any():
                h.update(r.part_ids.astype("<i4").tobytes())
            if r.walls is not None:
                h.update(f"{r.walls}".encode())
    return h.hexdigest()


def _shard(directory: Path, cycle: int) -> Path:
    return directory / "cycles" / f"{cycle:05d}.npz"


def _frozen_solids(part: Parts, spec: SceneSetSpec, directory: Path) -> list[Solid]:
    path = directory / "hulls.npz"
    if not path.is_file():
        pieces = {
            name: hull
            for kind, solid in enumerate(solids_of(part, spec.drop))
            for name, hull in zip(_piece_names(kind, len(solid.hulls)), solid.hulls, strict=True)
        }
        whole(path, lambda temporary: np.savez(temporary, **pieces))  # type: ignore[arg-type]
    with np.load(path) as stored:
        names = [
            [name for name in _piece_names(kind, len(stored.files)) if name in stored.files]
            for kind in range(len(part.parts))
        ]
        return [
            Solid(member, tuple(stored[name] for name in piece_names))
            for member, piece_names in zip(part.parts, names, strict=True)
        ]


def _piece_names(kind: int, count: int) -> list[str]:
    """Names of a part's convex pieces in the file; the first part's are what numpy calls them."""
    return [f"arr_{i}" if kind == 0 else f"part_{kind}_{i}" for i in range(count)]


def _read_manifest(directory: Path) -> dict | None:
    path = directory / "manifest.json"
    if not path.is_file():
        return None
    try:
        manifest = json.loads(path.read_text())
        return {key: manifest[key] for key in ("spec", "spec_digest", "content_digest")}
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} must be the manifest of a scene set, but it cannot be read: {error!r}") from error


def _write_manifest(directory: Path, part: Parts, spec: SceneSetSpec, content: str | None) -> None:
    manifest = {
        "part": part.name,
        "spec": spec.as_dict(),
        "spec_digest": spec.digest(),
        "content_digest": content,
    }
    write_json(directory / "manifest.json", manifest)


def find_record(part: Parts, caster: PartCaster, spec: SceneSetSpec, directory: Path, scene: int) -> SceneRecord:
    """Scene number ``scene`` of a set, or of the cycle it would belong to, when the set is not complete."""
    places = [(cycle, entry) for cycle in range(spec.cycles) for entry in range(len(spec.counts_of(cycle)))]
    if scene >= len(places):
        raise ValueError(f"scene must be below {len(places)} in split {spec.split}; got {scene}")
    if SceneSet.is_complete(directory):
        records = SceneSet.open(directory).records
        if scene >= len(records):
            raise ValueError(f"scene must be below {len(records)}, the scenes in {directory}; got {scene}")
        return records[scene]
    cycle, entry = places[scene]
    log.info("%s is not generated yet: simulating its cycle %d", directory, cycle)
    cycle_records = simulate_cycle(part, solids_of(part, spec.drop), caster, spec, cycle)
    if not cycle_records:
        raise ValueError(f"scene must lie in a cycle with a settled pile, cycle {cycle} has none; got {scene}")
    return cycle_records[min(entry, len(cycle_records) - 1)]
