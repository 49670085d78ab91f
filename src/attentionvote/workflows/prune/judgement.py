"""Who refers to what: from the registry and the newest models down to the data they were made of."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from attentionvote.files import is_locked
from attentionvote.registry.references import References, references
from attentionvote.workflows.prune.data_judgement import DataUsers, unreferenced_data
from attentionvote.workflows.prune.findings import Findings, Unreferenced
from attentionvote.workflows.prune.holdings import CHECKPOINTS, BundleFolder, Holdings, TrainingFolder, written_s
from attentionvote.workflows.prune.leftovers import leftovers
from attentionvote.workflows.prune.settings import PruneSettings
from attentionvote.workflows.train.job import RESULT


@dataclass
class PartJudgement:
    """What of one part's things is referred to.

    Args:
        cfg: where things lie.
        part: its name.
        holdings: of all folders of results.
        now_s: the time, seconds since 1970.
    """

    cfg: PruneSettings
    part: str
    holdings: Holdings
    now_s: float
    findings: Findings = field(default_factory=Findings)
    named: References = field(default_factory=References)
    has_runs: dict[str, bool] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.trainings = [training for training in self.holdings.trainings if training.part == self.part]
        self.bundles = [bundle for bundle in self.holdings.bundles if bundle.part == self.part]
        outputs = Path(self.cfg.outputs)
        self.train_folder, self.export_folder = outputs / "train" / self.part, outputs / "export" / self.part

    def judge(self) -> Findings:
        """Everything about the part."""
        runs = {training.run_id for training in self.trainings} | {bundle.run_id for bundle in self.bundles}
        try:
            self.named, has_runs = references(self.cfg.tracking.store, self.part, sorted(runs - {""}))
            self.has_runs = dict(has_runs)
        except ConnectionError as error:
            self._unjudged(f"bundles, trainings and data of {self.part} are kept, because {error}")
            self._add_checkpoints(self.trainings)
            return self.findings
        used_bundles = self._bundles()
        used_trainings = self._trainings(used_bundles)
        self._add_checkpoints(used_trainings)
        busy = self.holdings.busy(self.part)
        if busy is not None:
            self._unjudged(f"scenes and clouds of {self.part} are kept, because a process is at {busy}")
            return self.findings
        evaluations = self.holdings.evaluations.get(self.part, [])
        users = DataUsers(self._data_users(used_trainings), used_bundles, evaluations, self.named)
        root = Path(self.cfg.root)
        for kind, path in unreferenced_data(self.part, root, users, self._is_young, self.findings.unjudged):
            self._add(kind, path)
        return self.findings

    def _bundles(self) -> list[BundleFolder]:
        """The bundles that are referred to; the others are noted."""
        used, unknown = [], []
        for bundle in self.bundles:
            needed = bundle.is_latest or bundle.digest in self.named.bundles | self.holdings.shown
            if needed or bundle.path.parent != self.export_folder or bundle.path.is_symlink():
                used.append(bundle)
            elif not self.has_runs.get(bundle.run_id, False):
                used.append(bundle)
                unknown.append(bundle.path)
            else:
                self._add("bundle", bundle.path)
        self._say_unknown("bundles", unknown)
        return used

    def _trainings(self, used_bundles: list[BundleFolder]) -> list[TrainingFolder]:
        """The trainings that are referred to or unfinished; the others are noted."""
        runs = self.named.runs | {bundle.run_id for bundle in used_bundles} | self.holdings.listed
        ours = [training for training in self.trainings if training.path.parent == self.train_folder]
        complete = [training for training in ours if training.complete]
        newest = max(complete, key=lambda training: (training.path / RESULT).stat().st_mtime, default=None)
        used, unknown = [], []
        for training in self.trainings:
            elsewhere = training.path.parent != self.train_folder or training.path.is_symlink()
            needed = training is newest or training.path.name in self.holdings.listed or training.run_id in runs
            if elsewhere or not training.complete or needed or is_locked(training.path):
                used.append(training)
            elif not self.has_runs.get(training.run_id, False):
                used.append(training)
                unknown.append(training.path)
            else:
                self._add("training", training.path)
            if not elsewhere and not training.complete and not self._is_young(training.path):
                self.findings.unfinished.append(Unreferenced.of("unfinished", self.part, training.path, self.now_s))
        self._say_unknown("trainings", unknown)
        return used

    def _data_users(self, used: list[TrainingFolder]) -> list[TrainingFolder]:
        """The trainings whose data stay: of unfinished ones that do not say what theirs are the young ones."""
        return [
            training for training in used
            if training.data is not None or training.complete or self._is_young(training.path)
        ]  # fmt: skip

    def _add_checkpoints(self, used: list[TrainingFolder]) -> None:
        for training in used:
            folder = training.path / CHECKPOINTS
            ours = training.path.parent == self.train_folder and training.complete and folder.is_dir()
            if ours and not is_locked(training.path):
                self._add("checkpoints", folder)

    def _is_young(self, path: Path) -> bool:
        return self.now_s - written_s(path) <= self.cfg.unfinished_days * 86_400

    def _add(self, kind: str, path: Path) -> None:
        self.findings.unreferenced.append(Unreferenced.of(kind, self.part, path, self.now_s))

    def _unjudged(self, sentence: str) -> None:
        self.findings.unjudged.append(sentence)

    def _say_unknown(self, what: str, paths: list[Path]) -> None:
        if paths:
            names = ", ".join(path.name for path in paths)
            self._unjudged(
                f"{what} {names} of {self.part} are kept, because the tracking store does not have their runs: name "
                "theirs with tracking.store, or remove them by hand"
            )


def judge(cfg: PruneSettings, now_s: float) -> dict[str, Findings]:
    """What nobody refers to, by part; at last what killed processes left, under an empty name.

    Args:
        cfg: where things lie.
        now_s: the time, seconds since 1970.

    Raises:
        ValueError: when the tracking store's URI is impossible.
    """
    outputs, root = Path(cfg.outputs), Path(cfg.root)
    holdings = Holdings.below([outputs, *map(Path, cfg.also)])
    places = [root / "scenes", root / "clouds", outputs / "train", outputs / "export"]
    parts = {folder.name for place in places for folder in place.glob("[!.]*") if folder.is_dir()}
    findings = {part: PartJudgement(cfg, part, holdings, now_s).judge() for part in sorted(parts)}
    things = [thing for finding in findings.values() for thing in finding.unreferenced]
    going = {thing.path for thing in things if thing.kind != "checkpoints" or cfg.checkpoints}
    remains = [path for path in leftovers([*places[:2], outputs], now_s) if not going & {*path.parents}]
    findings[""] = Findings([Unreferenced.of("leftover", "", path, now_s) for path in remains])
    return findings
