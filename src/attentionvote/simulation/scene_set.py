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

from attentionvote.execution import Executor
from attentionvote.part import Part
from attentionvote.simulation.decomposition import Hulls, convex_hulls
from attentionvote.simulation.drop import drop_parts
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


def simulate_cycle(part: Part, hulls: Hulls, caster: PartCaster, spec: SceneSetSpec, cycle: int) -> list[SceneRecord]:
    """The scenes of one drop cycle; a pure function of its arguments."""
    physics_seed, *scene_seeds = spec.cycle_seed(cycle).spawn(1 + len(spec.drop_counts))
    rng = np.random.default_rng(physics_seed)
    scale = spec.bin.scaling_diameter(part, spec.drop_counts[-1])
    bin_size = spec.bin.sample(scale, rng)
    friction = float(rng.uniform(*spec.drop.friction))
    seeds = dict(zip(spec.drop_counts, scene_seeds, strict=True))
    records = []
    for pile in drop_parts(part, hulls, spec.drop_counts[-1], bin_size, friction, spec.drop, rng):
        count = len(pile.bin_from_part)
        if count not in seeds:
            continue
        scene_rng = np.random.default_rng(seeds[count])
        camera_from_bin = spec.camera.sample(scale, float(bin_size[2]), scene_rng)
        camera_from_part = camera_from_bin @ pile.bin_from_part
        surface = BinSurface(bin_size, camera_from_bin)
        records.append(
            SceneRecord(
                cycle=cycle,
                drop_count=count,
                camera_from_part=camera_from_part,
                visible_fraction=caster.visible_fraction(
                    camera_from_part, spec.camera.camera, surface, spec.visibility_stride
                ),
                camera=spec.camera.camera,
                camera_from_bin=camera_from_bin,
                bin_size=bin_size,
                friction=friction,
                scene_seed=int(scene_rng.integers(2**63)),
            )
        )
    return records


def generate_scene_set(
    part: Part,
    spec: SceneSetSpec,
    directory: Path,
    workers: int = 1,
    progress: bool = True,
    executor: Executor | None = None,
) -> SceneSet:
    """Generate what is missing of a scene set and open it; does nothing when it is complete.

    Args:
        part: the part; its digest must be the specification's.
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
            hulls = _frozen_hulls(part, spec, directory)
            missing = [c for c in range(spec.cycles) if not _shard(directory, c).is_file()]
            title = f"{part.name}, {spec.split} scenes"
            done = spec.cycles - len(missing)
            run_cycles(part, hulls, spec, directory, missing, workers, progress, title, done, executor)
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
    return h.hexdigest()


def store_cycle(directory: Path, cycle: int, records: list[SceneRecord]) -> None:
    """Store the scenes of one cycle."""
    save_records(_shard(directory, cycle), records)


def _shard(directory: Path, cycle: int) -> Path:
    return directory / "cycles" / f"{cycle:05d}.npz"


def _frozen_hulls(part: Part, spec: SceneSetSpec, directory: Path) -> Hulls:
    path = directory / "hulls.npz"
    if not path.is_file():
        hulls = convex_hulls(part, spec.drop.hull_threshold, spec.drop.hull_vertices)
        temporary = directory / f".hulls.npz.{os.getpid()}"
        with temporary.open("wb") as file:
            np.savez(file, *hulls)
        temporary.replace(path)
    with np.load(path) as stored:
        return tuple(stored[f"arr_{i}"] for i in range(len(stored.files)))


def _read_manifest(directory: Path) -> dict | None:
    path = directory / "manifest.json"
    if not path.is_file():
        return None
    try:
        manifest = json.loads(path.read_text())
        return {key: manifest[key] for key in ("spec", "spec_digest", "content_digest")}
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} must be the manifest of a scene set, but it cannot be read: {error!r}") from error


def _write_manifest(directory: Path, part: Part, spec: SceneSetSpec, content: str | None) -> None:
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
