"""What ``evaluate`` and ``promote`` share: which bundle, the frozen evaluation set, and the measurement on it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from attentionvote.inference import Bundle, load_bundle
from attentionvote.inference.bundles.signature import fingerprint, trusted_key
from attentionvote.part import Parts
from attentionvote.workflows.evaluate.frozen_set import scenes_of, set_spec
from attentionvote.workflows.evaluate.settings import MeasuredBundle

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    from attentionvote.measurement.models import Measurement
    from attentionvote.measurement.scenes import MeasuredScenes
    from attentionvote.scene import Scene


@dataclass(frozen=True)
class EvaluationJob:
    """One bundle to be measured: its part, and the key that signed it."""

    cfg: MeasuredBundle
    part: Parts
    bundle: Bundle
    key: Ed25519PublicKey

    @classmethod
    def find(cls, cfg: MeasuredBundle) -> EvaluationJob:
        """The bundle that a configuration names, verified, and the set it is measured on.

        Raises:
            ValueError: when there is no such bundle, it cannot be trusted, or a setting is impossible.
        """
        part: Parts = cfg.object()
        set_spec(cfg, part)
        key = trusted_key(cfg.trusted_key)
        bundle = load_bundle(_folder(Path(cfg.bundles) / part.name, cfg.bundle, part.name), key)
        if bundle.card.part.digest != part.digest:
            raise ValueError(
                f"bundle {bundle.digest[:12]} must be of the part {part.name} as it is now ({part.digest[:12]}), got "
                f"{bundle.card.part.digest[:12]}: its mesh, diameter or symmetry has changed, train and export it again"
            )
        return cls(cfg, part, bundle, key)

    @property
    def signer(self) -> str:
        """Fingerprint of the key whose signature the bundle has."""
        return fingerprint(self.key)

    @property
    def otherwise(self) -> str:
        """What is asked of the model beside its card, for names of files."""
        peak = self.cfg.evaluation.peak_threshold
        return "" if peak is None else f"-peak{peak:g}"

    @property
    def is_standard(self) -> bool:
        """Whether the model is measured as cells run it, on the set that decides promotions."""
        evaluation = self.cfg.evaluation
        return evaluation.split == "evaluation" and evaluation.dataset is None and not self.otherwise

    @property
    def is_elsewhere(self) -> bool:
        """Whether a word places the camera elsewhere: such figures tell what a model bears, beside the run's own."""
        return any(word.lstrip("+").startswith("simulation.camera.distance") for word in self.cfg.words)

    def evaluation_set(self) -> MeasuredScenes:
        """The scenes to measure on, see ``scenes_of``.

        Raises:
            ValueError: when the model was trained with them, or a dataset does not hold the part.
        """
        from attentionvote.measurement.scenes import EvaluationSet

        scenes = scenes_of(self.cfg, self.part)
        if not isinstance(scenes, EvaluationSet):
            scenes.check_unseen(self.bundle.card.data)
        elif (made := scenes.scenes.digest) in self.bundle.card.data.values():
            raise ValueError(
                f"the evaluation set {made[:12]} must not be one that the model was trained with, but it is: change "
                "simulation.seed"
            )
        return scenes

    def measure(self, bundles: Sequence[Bundle], frozen: MeasuredScenes) -> list[Measurement]:
        """Measure bundles side by side, with a progress bar."""
        from rich.console import Console
        from rich.progress import track

        from attentionvote.measurement.models import measure

        def shown(clouds: Iterator[Scene]) -> Iterable[Scene]:
            what = "evaluating" if len(bundles) == 1 else "evaluating candidate and champion"
            return track(clouds, f"{self.part.name}: {what}", len(frozen), console=Console(stderr=True))

        evaluation = self.cfg.evaluation
        return measure(bundles, frozen, evaluation.threads, shown, evaluation.peak_threshold)


def _folder(bundles: Path, name: str, part: str) -> Path:
    """The bundle's folder below ``place``: ``latest``, or the only one whose name begins with ``name``."""
    if name == "latest" and (bundles / name).exists():
        return bundles / name
    matches = [p for p in sorted(bundles.glob("*")) if p.name.startswith(name) and p.is_dir() and not p.is_symlink()]
    if len(matches) == 1:
        return matches[0]
    have = [
        path.name for path in sorted(bundles.glob("*")) if (path / "manifest.json").is_file() and not path.is_symlink()
    ]
    if not have:
        raise ValueError(f"{bundles} must hold a bundle, got none: run `make export OBJECT={part}`")
    raise ValueError(f"bundle must name one bundle, {name!r} names {len(matches)}; there are {', '.join(have)}")
