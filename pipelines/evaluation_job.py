"""What ``evaluate`` and ``promote`` share: which bundle, the frozen evaluation set, and the measurement on it."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from hardware import cores
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from attentionvote.inference import Bundle, load_bundle
from attentionvote.inference.signature import PUBLIC_NAME, fingerprint, keys_folder, load_public_key
from attentionvote.part import Parts
from attentionvote.simulation import SceneSetSpec, Sensor, scene_set_directory, scene_set_specs

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    from attentionvote.registry.measurement import EvaluationSet, Measurement
    from attentionvote.simulation import SceneRecord

log = logging.getLogger("attentionvote.evaluate")
SPLIT = "evaluation"  # enters the seeds: no cycle of another split occurs in it


@dataclass(frozen=True)
class EvaluationJob:
    """One bundle to be measured: its part, the key that signed it, what makes the evaluation set."""

    cfg: DictConfig
    part: Parts
    bundle: Bundle
    key: Ed25519PublicKey
    spec: SceneSetSpec

    @classmethod
    def find(cls, cfg: DictConfig) -> EvaluationJob:
        """The bundle that a configuration names, verified, and the set it is measured on.

        Raises:
            ValueError: when there is no such bundle, it cannot be trusted, or a setting is impossible.
        """
        part: Parts = instantiate(cfg.object)
        settings = OmegaConf.to_container(cfg.simulation, resolve=True)
        assert isinstance(settings, dict)
        spec = scene_set_specs(part, settings | {"cycles": {SPLIT: cfg.evaluation.cycles}})[SPLIT]
        Sensor(**cfg.evaluation.sensor)
        key = trusted_key(cfg.trusted_key)
        bundle = load_bundle(_folder(Path(cfg.bundles) / part.name, cfg.bundle, part.name), key)
        if bundle.card.part.digest != part.digest:
            raise ValueError(
                f"bundle {bundle.digest[:12]} must be of the part {part.name} as it is now ({part.digest[:12]}), got "
                f"{bundle.card.part.digest[:12]}: its mesh, diameter or symmetry has changed, train and export it again"
            )
        return cls(cfg, part, bundle, key, spec)

    @property
    def signer(self) -> str:
        """Fingerprint of the key whose signature the bundle has."""
        return fingerprint(self.key)

    def evaluation_set(self) -> EvaluationSet:
        """The frozen set, generated when it is not there yet."""
        from attentionvote.data import CloudSettings
        from attentionvote.registry.measurement import EvaluationSet
        from attentionvote.simulation import generate_scene_set

        directory = scene_set_directory(Path(self.cfg.root) / "scenes", self.part.name, self.spec)
        scenes = generate_scene_set(self.part, self.spec, directory, self.cfg.workers or cores())
        chosen = self.cfg.evaluation
        settings = CloudSettings(Sensor(**chosen.sensor), density=chosen.density, pool=chosen.density)
        frozen = EvaluationSet(scenes, self.part, settings)
        if scenes.digest in self.bundle.card.data.values():
            raise ValueError(
                f"the evaluation set {scenes.digest[:12]} must not be one that the model was trained with, but it is: "
                "change simulation.seed"
            )
        log.info("%s: evaluation set %s, %d scenes", self.part.name, frozen.digest[:12], len(frozen))
        return frozen

    def measure(self, bundles: Sequence[Bundle], frozen: EvaluationSet) -> list[Measurement]:
        """Measure bundles side by side, with a progress bar."""
        from rich.console import Console
        from rich.progress import track

        from attentionvote.registry.measurement import measure

        def shown(records: Sequence[SceneRecord]) -> Iterable[SceneRecord]:
            what = "evaluating" if len(bundles) == 1 else "evaluating candidate and champion"
            return track(records, f"{self.part.name}: {what}", len(records), console=Console(stderr=True))

        return measure(bundles, frozen, self.cfg.evaluation.threads, shown)


def trusted_key(named: str | None) -> Ed25519PublicKey:
    """The public key whose signature bundles must have.

    Raises:
        ValueError: when there is none.
    """
    return load_public_key(keys_folder() / PUBLIC_NAME if named is None else Path(named))


def _folder(place: Path, name: str, part: str) -> Path:
    """The bundle's folder below ``place``: ``latest``, or the only one whose name begins with ``name``."""
    if name == "latest" and (place / name).exists():
        return place / name
    found = [p for p in sorted(place.glob("*")) if p.name.startswith(name) and p.is_dir() and not p.is_symlink()]
    if len(found) == 1:
        return found[0]
    have = [
        path.name for path in sorted(place.glob("*")) if (path / "manifest.json").is_file() and not path.is_symlink()
    ]
    if not have:
        raise ValueError(f"{place} must hold a bundle, got none: run `make export OBJECT={part}`")
    raise ValueError(f"bundle must name one bundle, {name!r} names {len(found)}; there are {', '.join(have)}")
