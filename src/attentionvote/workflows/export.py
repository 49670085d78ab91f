"""What ``make export`` does, step by step: which training, what it needs, whether it is done, and the work."""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import attentionvote
from attentionvote.execution.hardware import cores
from attentionvote.export.proof import judge, prove
from attentionvote.files import locked_folder, read_json, write_json
from attentionvote.inference import Bundle, BundleError, load_bundle
from attentionvote.inference.bundles.signature import (
    PRIVATE_NAME,
    PUBLIC_NAME,
    fingerprint,
    keys_folder,
    load_private_key,
    make_keys,
)
from attentionvote.part import Parts
from attentionvote.workflows.settings import ExportSettings
from attentionvote.workflows.train.job import MODEL, RESULT

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    from attentionvote.contract import ModelCard
    from attentionvote.data.clouds import Clouds
    from attentionvote.data.dataset_split import DatasetSplit
    from attentionvote.data.sensing import CloudSettings
    from attentionvote.export.parity_record import Limits
    from attentionvote.model.network import AttentionVote
    from attentionvote.simulation.scene_set import SceneSet

log = logging.getLogger("attentionvote.export")


@dataclass(frozen=True)
class ExportJob:
    """One export: its settings, the part (or set of parts), the training it is of, the key that signs."""

    cfg: ExportSettings
    part: Parts
    training: Path
    trained: dict[str, Any]
    key: Ed25519PrivateKey

    @classmethod
    def find(cls, cfg: ExportSettings) -> ExportJob:
        """The training that a configuration names, and the key, made when there is none.

        Raises:
            ValueError: when there is no such training, or more than one; or when the key cannot be had.
        """
        part: Parts = cfg.object()
        if cfg.scenes < cfg.limits.scenes:
            raise ValueError(f"scenes must be at least limits.scenes ({cfg.limits.scenes}), got {cfg.scenes}")
        folder = Path(cfg.trained) / part.name
        results = {p.parent: read_json(p) for p in folder.glob(f"*/{RESULT}") if (p.parent / MODEL).is_file()}
        complete = {path: result for path, result in results.items() if result is not None}
        if not complete:
            raise ValueError(f"{folder} must hold a complete training, got none: run `make train OBJECT={part.name}`")
        if cfg.run is not None:
            runs = {path: str(result.get("run_id", "")) for path, result in complete.items()}
            named = [p for p, run_id in runs.items() if p.name.startswith(cfg.run) or run_id.startswith(cfg.run)]
            if len(named) != 1:
                have = ", ".join(f"{path.name} (run {run_id[:8]})" for path, run_id in sorted(runs.items()))
                raise ValueError(
                    f"run must name one complete training, {cfg.run!r} names {len(named)}; there are {have}"
                )
            complete = {named[0]: complete[named[0]]}
        newest, *older = sorted(complete, key=lambda path: (path / RESULT).stat().st_mtime, reverse=True)
        if older:
            have = ", ".join(_described(path, complete[path]) for path in older[:5])
            log.info("the newest training is taken, %s; RUN=... takes %s", _described(newest, complete[newest]), have)
        return cls(cfg, part, newest, complete[newest], _signing_key(cfg.signing_keys))

    @property
    def folder(self) -> Path:
        """Of the part's bundles."""
        return Path(self.cfg.outputs) / self.part.name

    def locked(self) -> AbstractContextManager[None]:
        """Be the only process that writes bundles of this part; FolderUnavailable when another one does."""
        return locked_folder(self.folder, self.cfg.outputs, "part's export")

    def done(self) -> dict[str, Any] | None:
        """What this export ended with, when it is done and its bundle still whole; ``latest`` points at it then."""
        result = read_json(self._record)
        if result is None or self.cfg.force:
            return None
        try:
            bundle = load_bundle(Path(str(result.get("bundle"))), self.key.public_key())
        except BundleError as error:
            log.warning("%s: it is exported again", error)
            return None
        from attentionvote.export.bundle_writer import point_latest

        point_latest(bundle.path)
        self._write_triton(bundle)
        log.info("this export is done (force=true repeats it): %s", bundle.path)
        return result

    def prepare(self) -> ExportWork:
        """Everything the work needs, checked.

        Raises:
            ValueError: when the checkpoint, the part or the held-out scenes are not what they were.
        """
        from attentionvote.data.sensing import CloudSettings
        from attentionvote.export import held_out
        from attentionvote.export.checkpoint_card import model_card, used_otherwise
        from attentionvote.training.checkpoint import load_trained

        model, metadata = load_trained(self.training / MODEL)
        metadata = used_otherwise(model, metadata, self.cfg.voting_radius, self.cfg.peak_threshold)
        root = Path(self.cfg.root)
        scenes = held_out.find_test_scenes(metadata, self.part, root)
        settings = CloudSettings.of(metadata["clouds"])
        clouds = held_out.measured(scenes, self.part, settings, root, self.cfg.workers or cores())
        indices = [i for i in held_out.spread(len(clouds), self.cfg.scenes) if clouds.count(i) >= 3]
        if len(indices) < self.cfg.limits.scenes:
            raise ValueError(
                f"the proof must have at least limits.scenes ({self.cfg.limits.scenes}) held-out scenes with parts in "
                f"them, got {len(indices)}: train with more simulation.cycles.test or data.held_out.test, or lower "
                "limits.scenes"
            )
        run_id, commit = (str(self.trained.get(name) or "") for name in ("run_id", "commit"))
        card = model_card(model, metadata, self.part, *held_out.working_volume(clouds, scenes), run_id, commit)
        return ExportWork(self, model, card, scenes, settings, clouds, indices, self.cfg.limits)

    def finish(self, bundle: Bundle, figures: dict[str, Any]) -> dict[str, Any]:
        """Record what was done; the dictionary of the JSON line."""
        result = {
            "stage": "export",
            "object": self.part.name,
            "bundle": str(bundle.path),
            "digest": bundle.digest,
            "run_id": bundle.card.run_id,
            "signed_by": fingerprint(self.key.public_key()),
            **figures,
        } | self._write_triton(bundle)
        write_json(self._record, result)
        log.info("%s: signed bundle %s", self.part.name, bundle.path)
        return result

    def _write_triton(self, bundle: Bundle) -> dict[str, str]:
        if self.cfg.triton is None:
            return {}
        from attentionvote.export.triton_layout import write_triton

        return {"triton": str(write_triton(bundle, Path(self.cfg.triton)))}

    @cached_property
    def _record(self) -> Path:
        """Named by a digest of everything that decides what is exported: weights, code, versions, settings."""
        from attentionvote.export.checkpoint_card import package_versions

        code = hashlib.sha256()
        package = Path(attentionvote.__file__).parent
        for path in sorted(p for p in package.rglob("*") if p.suffix in (".py", ".c") and _decides(p, package)):
            code.update(path.read_bytes())
        weights = hashlib.sha256((self.training / MODEL).read_bytes()).hexdigest()
        content = {
            "weights": weights,
            "trained": [self.trained.get("run_id"), self.trained.get("commit")],
            "part": self.part.digest,
            "code": code.hexdigest(),
            "versions": package_versions(),
            "signer": fingerprint(self.key.public_key()),
            "settings": [self.cfg.scenes, self.cfg.golden, asdict(self.cfg.limits)],
            "used": [self.cfg.voting_radius, self.cfg.peak_threshold],
        }
        return self.folder / f"export-{hashlib.sha256(json.dumps(content).encode()).hexdigest()[:12]}.json"


@dataclass(frozen=True)
class ExportWork:
    """An export whose needs are met."""

    job: ExportJob
    model: AttentionVote
    card: ModelCard
    scenes: SceneSet | DatasetSplit
    settings: CloudSettings
    clouds: Clouds
    indices: list[int]
    limits: Limits

    def run(self) -> dict[str, Any]:
        """Trace, prove, sign; the dictionary of the JSON line.

        Raises:
            ValueError: when graph and checkpoint differ by more than the limits; the report is written all the same.
        """
        from rich.console import Console

        from attentionvote.export.bundle_writer import write_bundle
        from attentionvote.export.onnx_file import export_graph

        name, start = self.job.part.name, time.monotonic()
        log.info("%s: tracing the network of %s", name, self.job.training)
        with Console(stderr=True).status("tracing and converting, about a minute"):
            graph = export_graph(self.model, self.card)
        log.info("%s: one ONNX file of %.1f MB in %.0f s", name, len(graph) / 1e6, time.monotonic() - start)
        parity, milliseconds = prove(self.model, graph, self.card, self.job.part, self.clouds, self.indices)
        figures = {
            "parity": {path: p.as_dict() for path, p in parity.items()},
            "milliseconds": milliseconds,
            "limits": asdict(self.job.cfg.limits),
        }
        report = self.job.folder / f"parity-{self.job.training.name}.json"
        write_json(report, {"training": str(self.job.training), "scenes": self.indices, **figures})
        judge(parity, self.limits, report)
        card = replace(self.card, parity={"limits": figures["limits"], "paths": figures["parity"]})
        clouds, count = self._golden(), self.job.cfg.golden
        bundle = write_bundle(graph, card, self.job.part, clouds, count, self.job.key, self.job.folder)
        return self.job.finish(bundle, figures)

    def _golden(self) -> Iterator[tuple[str, Any]]:
        """Whole clouds of held-out scenes: first the most different fillings, then whatever else there is."""
        from attentionvote.export import held_out

        first = [self.indices[i] for i in held_out.spread(len(self.indices), self.job.cfg.golden)]
        order = dict.fromkeys([*first, *self.indices])
        yield from held_out.whole_clouds(self.scenes, self.job.part, self.settings, order)


def _decides(path: Path, package: Path) -> bool:
    """Whether a file of the package has a say in what is exported; other verbs, tables and pictures have none."""
    room, *rest = path.relative_to(package).parts
    others = ("command", "drawing", "measurement", "registry", "tracking", "workflows")
    return room not in others or rest == ["export.py"]


def _described(training: Path, result: dict[str, Any]) -> str:
    """A training in a few words, with its average precision at 10, 5 and 2 % of D."""
    metrics = result.get("metrics") or {}
    figures = "/".join(f"{metrics[f'ap_{k}']:.3f}" for k in (10, 5, 2) if f"ap_{k}" in metrics)
    return f"{training.name} (AP {figures or 'unknown'})"


def _signing_key(folder: str | None) -> Ed25519PrivateKey:
    keys = keys_folder() if folder is None else Path(folder)
    if not ((keys / PRIVATE_NAME).is_file() and (keys / PUBLIC_NAME).is_file()):
        private, public = make_keys(keys)
        log.info("a signing key was made; keep %s secret, give %s to the cells", private, public)
    return load_private_key(keys / PRIVATE_NAME)
