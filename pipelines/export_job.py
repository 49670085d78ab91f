"""What ``make export`` does, step by step."""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from hardware import cores
from hydra.utils import instantiate
from omegaconf import DictConfig
from training_job import MODEL, RESULT, write_json

from attentionvote.geometry import native
from attentionvote.inference.signature import PRIVATE_NAME, fingerprint, keys_folder, load_private_key, make_keys
from attentionvote.part import Part

log = logging.getLogger("attentionvote.export")
_TIMED_ROUNDS = 7


@dataclass(frozen=True)
class ExportJob:
    """One export: the training it is of, the part, the settings."""

    cfg: DictConfig
    part: Part
    training: Path
    trained: dict[str, Any]

    @classmethod
    def find(cls, cfg: DictConfig) -> ExportJob:
        """The training that a configuration names.

        Raises:
            ValueError: when there is none, or when more than one begins with ``run``.
        """
        part: Part = instantiate(cfg.object)
        if cfg.scenes < cfg.limits.scenes:
            raise ValueError(f"scenes must be at least limits.scenes ({cfg.limits.scenes}), got {cfg.scenes}")
        folder = Path(cfg.trained) / part.name
        complete = {}
        for path in folder.glob(f"*/{RESULT}"):
            if (path.parent / MODEL).is_file():
                complete[path.parent] = json.loads(path.read_text(encoding="utf-8"))
        if not complete:
            raise ValueError(f"{folder} must hold a complete training, got none: run `make train OBJECT={part.name}`")
        if cfg.run is not None:
            wanted = str(cfg.run)
            named = {p: r for p, r in complete.items() if p.name.startswith(wanted) or r["run_id"].startswith(wanted)}
            if len(named) != 1:
                have = ", ".join(f"{p.name} (run {r['run_id'][:8]})" for p, r in sorted(complete.items()))
                raise ValueError(
                    f"run must name one complete training, {wanted!r} names {len(named)}; there are {have}"
                )
            complete = named
        newest = max(complete, key=lambda path: (path / RESULT).stat().st_mtime)
        return cls(cfg, part, newest, complete[newest])

    def run(self) -> dict[str, Any]:
        """Everything; the dictionary of the JSON line.

        Raises:
            ValueError: when graph and checkpoint differ by more than the limits; the report is written all the same.
        """
        cfg, folder = self.cfg, Path(self.cfg.outputs) / self.part.name
        key = self._signing_key()
        record = folder / f"export-{self._identity(fingerprint(key.public_key()))}.json"
        if record.is_file() and not cfg.force:
            done: dict[str, Any] = json.loads(record.read_text(encoding="utf-8"))
            if (Path(done["bundle"]) / "manifest.json").is_file():
                log.info("this export is done (force=true repeats it): %s", done["bundle"])
                return done
        from attentionvote.export import held_out, write_bundle, write_triton
        from attentionvote.simulation import PartCaster

        model, metadata, clouds, scenes, settings = self._load()
        card = self._card(model, metadata, clouds)
        log.info("%s: tracing the network of %s", self.part.name, self.training)
        start = time.monotonic()
        graph = self._graph(model, card)
        log.info("%s: one ONNX file of %.1f MB in %.0f s", self.part.name, len(graph) / 1e6, time.monotonic() - start)
        indices = held_out.spread(len(clouds), cfg.scenes)
        parity, times = self._prove(model, graph, card, clouds, indices)
        figures = {name: p.as_dict() for name, p in parity.items()}
        folder.mkdir(parents=True, exist_ok=True)
        report = folder / f"parity-{self.training.name}.json"
        write_json(report, {"training": str(self.training), "paths": figures, "milliseconds": times})
        for name, value in times.items():
            log.info("one scene, one thread: %7.1f ms  %s", value, name)
        self._judge(parity, report)
        caster = PartCaster(self.part)
        golden = {
            f"scene_{scenes.records[i].cycle:03d}_{scenes.records[i].drop_count:03d}": held_out.sensor_cloud(
                scenes, i, caster, settings
            )
            for i in held_out.spread(len(clouds), cfg.golden)
        }
        bundle = write_bundle(graph, replace(card, parity=figures), self.part, golden, key, folder)
        result = {
            "stage": "export",
            "object": self.part.name,
            "bundle": str(bundle.path),
            "digest": bundle.digest,
            "run_id": card.run_id,
            "signed_by": fingerprint(key.public_key()),
            "parity": figures,
            "milliseconds": times,
        }
        if cfg.triton is not None:
            result["triton"] = str(write_triton(bundle, Path(cfg.triton)))
        write_json(record, result)
        log.info("%s: signed bundle %s", self.part.name, bundle.path)
        return result

    def _signing_key(self) -> Any:
        folder = keys_folder() if self.cfg.signing_keys is None else Path(self.cfg.signing_keys)
        if not (folder / PRIVATE_NAME).is_file():
            _, public = make_keys(folder)
            log.info("a signing key was made; keep %s secret, give %s to the cells", folder / PRIVATE_NAME, public)
        return load_private_key(folder / PRIVATE_NAME)

    def _identity(self, signer: str) -> str:
        """Digest of everything that decides what is exported."""
        import attentionvote.export

        code = hashlib.sha256()
        for path in sorted(Path(attentionvote.export.__file__).parent.glob("*.py")):
            code.update(path.read_bytes())
        weights = hashlib.sha256((self.training / MODEL).read_bytes()).hexdigest()
        content = [weights, signer, code.hexdigest(), self.cfg.scenes, self.cfg.golden, str(self.cfg.triton)]
        return hashlib.sha256(json.dumps([*content, dict(self.cfg.limits)]).encode()).hexdigest()[:12]

    def _load(self) -> Any:
        from attentionvote.export import held_out
        from attentionvote.training.checkpoint import load_trained

        model, metadata = load_trained(self.training / MODEL)
        root = Path(self.cfg.root)
        scenes = held_out.find_test_scenes(metadata, self.part, root)
        settings = held_out.cloud_settings(metadata)
        clouds = held_out.measured(scenes, self.part, settings, root, self.cfg.workers or cores())
        return model, metadata, clouds, scenes, settings

    def _card(self, model: Any, metadata: dict[str, Any], clouds: Any) -> Any:
        from attentionvote.export import held_out, model_card

        distance, extent = held_out.working_volume(clouds)
        commit = str(self.trained.get("commit") or "")
        return model_card(model, metadata, self.part, distance, extent, self.trained["run_id"], commit)

    def _graph(self, model: Any, card: Any) -> bytes:
        from rich.console import Console

        from attentionvote.export import export_graph

        with Console(stderr=True).status("tracing and converting, half a minute"):
            return export_graph(model, card)

    def _prove(self, model: Any, graph: bytes, card: Any, clouds: Any, indices: list[int]) -> Any:
        """Parity by execution path, and milliseconds a scene of checkpoint and graph, one thread each."""
        import torch
        from rich.console import Console
        from rich.progress import track

        from attentionvote.export import held_out, measure_parity
        from attentionvote.inference.runtime import Session, providers

        torch.set_num_threads(1)
        batch = next(held_out.samples(clouds, indices[-1:], card.points, model.layout))
        points, normals = batch.points.numpy(), batch.normals.numpy()
        # Sampling and neighbours are given to plain torch: the slow references of those would only flatter the graph.
        work: dict[str, Callable[[], object]] = {
            "torch with C kernels": partial(model, batch.points, batch.normals),
            "torch eager, neighbours given": native.disabled()(
                partial(model, batch.points, batch.normals, batch.found)
            ),
        }
        parity = {}
        for name, provider in providers().items():
            session = Session(graph, card, threads=1, provider=provider)
            drawn = held_out.samples(clouds, indices, card.points, model.layout)
            shown = track(drawn, f"{self.part.name}: proof on {name}", len(indices), console=Console(stderr=True))
            thresholds = card.peak_threshold, card.confidence_threshold
            parity[name] = measure_parity(model, session.run, shown, self.part, *thresholds)
            work[name] = partial(session.run, points, normals)
        with torch.no_grad():
            return parity, _milliseconds(work)

    def _judge(self, parity: dict[str, Any], report: Path) -> None:
        from attentionvote.export import Limits, table

        limits = Limits(**self.cfg.limits)
        for line in table(parity, limits):
            log.info(line)
        broken = [f"{name}: {sentence}" for name, p in parity.items() for sentence in p.violations(limits)]
        if broken:
            raise ValueError(
                f"graph and checkpoint must be equal within the limits, but {'; '.join(broken)}: "
                f"nothing is exported, the report is {report}"
            )


def _milliseconds(work: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Least processor time of some rounds: on a shared machine the wall clock says less, and rounds share the load."""
    taken: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(_TIMED_ROUNDS + 1):
        for name, run in work.items():
            start = time.process_time()
            run()
            taken[name].append(1000 * (time.process_time() - start))
    return {name: round(min(values[1:]), 2) for name, values in taken.items()}  # the first round warms up
