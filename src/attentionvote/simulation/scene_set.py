"""Scene sets: many drop cycles, one file each, the same bits from the same specification.

A set's directory holds ``manifest.json`` (specification and, once complete, the digest of the content), ``hulls.npz``
(so that a continued set uses the same convex pieces) and ``cycles/00000.npz``.... Every cycle has its own seed, drawn
from (seed, split, cycle): neither the number of workers nor an interruption changes anything, and no cycle of one split
occurs in another.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from attentionvote.execution import Executor
from attentionvote.part import Parts
from attentionvote.simulation.decomposition import convex_hulls
from attentionvote.simulation.drop import DropSettings, Solid, drop_parts
from attentionvote.simulation.raycast import BinSurface, PartCaster
from attentionvote.simulation.scene_record import SceneRecord, load_records, save_records
from attentionvote.simulation.scene_spec import SceneSetSpec, scene_set_directory, scene_set_specs

__all__ = [
    "SceneSet",
    "SceneSetSpec",
    "content_digest",
    "generate_scene_set",
    "scene_set_directory",
    "scene_set_specs",
    "simulate_cycle",
]


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

    def __len__(self) -> int:
        return len(self.records)

    def __iter__(self) -> Iterator[SceneRecord]:
        return iter(self.records)


def draw_part_ids(parts: int, count: int, rng: np.random.Generator) -> NDArray[np.int32]:
    """``(count,)`` which of ``parts`` each drop is: every part once, in random order, then any, so that a pile of at
    least as many drops as parts holds all of them ("objects including all categories", paper section 4.1)."""
    return np.concatenate([rng.permutation(parts), rng.integers(parts, size=count)])[:count].astype(np.int32)


def simulate_cycle(
    part: Parts, solids: Sequence[Solid], caster: PartCaster, spec: SceneSetSpec, cycle: int
) -> list[SceneRecord]:
    """The scenes of one drop cycle; a pure function of its arguments.

    Args:
        part: what lies in the bin.
        solids: of its parts, in their order.
        caster: of the same.
        spec: of the set.
        cycle: which one.
    """
    most = spec.drop_counts[-1]
    physics_seed, *scene_seeds, parts_seed = spec.cycle_seed(cycle).spawn(2 + len(spec.drop_counts))
    part_ids = draw_part_ids(len(solids), most, np.random.default_rng(parts_seed))
    rng = np.random.default_rng(physics_seed)
    scale = spec.bin.scaling_diameter(part, most)
    bin_size = spec.bin.sample(scale, rng)
    friction = float(rng.uniform(*spec.drop.friction))
    seeds = dict(zip(spec.drop_counts, scene_seeds, strict=True))
    records = []
    for pile in drop_parts(solids, part_ids, bin_size, friction, spec.drop, rng):
        count = len(pile.bin_from_part)
        if count not in seeds:
            continue
        scene_rng = np.random.default_rng(seeds[count])
        camera_from_bin = spec.camera.sample(scale, float(bin_size[2]), scene_rng)
        camera_from_part = camera_from_bin @ pile.bin_from_part
        surface, own_ids = BinSurface(bin_size, camera_from_bin), part_ids[:count]
        records.append(
            SceneRecord(
                cycle=cycle,
                drop_count=count,
                camera_from_part=camera_from_part,
                visible_fraction=caster.visible_fraction(
                    camera_from_part, spec.camera.camera, surface, spec.visibility_stride, own_ids
                ),
                camera=spec.camera.camera,
                camera_from_bin=camera_from_bin,
                bin_size=bin_size,
                friction=friction,
                scene_seed=int(scene_rng.integers(2**63)),
                part_ids=own_ids,
            )
        )
    return records


def solids_of(part: Parts, settings: DropSettings) -> list[Solid]:
    """The parts with their convex pieces."""
    return [Solid(one, convex_hulls(one, settings.hull_threshold, settings.hull_vertices)) for one in part.parts]


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
        OSError: when the worker of one cycle died again and again; what is finished is kept and the next call goes on
            from there.
    """
    from attentionvote.simulation.cycle_pool import run_cycles

    if part.digest != spec.part_digest:
        raise ValueError(
            f"{part.name}: the scene set is specified for part {spec.part_digest[:12]}, this is {part.digest[:12]}"
        )
    if workers < 1:
        raise ValueError(f"workers must be at least 1, got {workers}")
    directory.mkdir(parents=True, exist_ok=True)
    with _locked(directory):
        manifest = _read_manifest(directory)
        if manifest is not None and manifest["spec_digest"] != spec.digest():
            raise ValueError(
                f"{directory} holds scene set {manifest['spec_digest'][:12]}, but {spec.digest()[:12]} was asked for: "
                "choose another directory"
            )
        if manifest is None or manifest["content_digest"] is None:
            (directory / "cycles").mkdir(exist_ok=True)
            for leftover in [*directory.glob(".*.*.*"), *directory.glob("cycles/.*")]:
                leftover.unlink()  # temporary files of a killed process; the lock says nobody writes now
            if manifest is None:
                _write_manifest(directory, part, spec, None)
            solids = _frozen_solids(part, spec, directory)
            missing = [c for c in range(spec.cycles) if not _shard(directory, c).is_file()]
            title = f"{part.name}, {spec.split} scenes"
            done = spec.cycles - len(missing)
            run_cycles(part, solids, spec, directory, missing, workers, progress, title, done, executor)
            _write_manifest(directory, part, spec, content_digest(directory, spec.cycles))
    return SceneSet.open(directory)


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
    return h.hexdigest()


def store_cycle(directory: Path, cycle: int, records: list[SceneRecord]) -> None:
    """Store the scenes of one cycle."""
    save_records(_shard(directory, cycle), records)


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
        temporary = directory / f".hulls.npz.{os.getpid()}"
        with temporary.open("wb") as file:
            np.savez(file, **pieces)  # type: ignore[arg-type]
        temporary.replace(path)
    with np.load(path) as stored:
        names = [
            [name for name in _piece_names(kind, len(stored.files)) if name in stored.files]
            for kind in range(len(part.parts))
        ]
        return [Solid(one, tuple(stored[name] for name in own)) for one, own in zip(part.parts, names, strict=True)]


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
    temporary = directory / f".manifest.json.{os.getpid()}"
    temporary.write_text(json.dumps(manifest, indent=2) + "\n")
    temporary.replace(directory / "manifest.json")


@contextmanager
def _locked(directory: Path) -> Iterator[None]:
    """Hold the directory's lock; the system releases it when the process dies, however that happens."""
    with (directory / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
