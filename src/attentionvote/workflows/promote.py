"""What ``make promote`` does, step by step: where the champion stands, the measurement, the gates, the move."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from attentionvote.command.errors import ConfigurationError, Refused
from attentionvote.command.tables import show_table
from attentionvote.evaluation.scores import HEADLINES
from attentionvote.inference import Bundle
from attentionvote.inference.bundles.signature import trusted_key
from attentionvote.measurement.models import Measurement
from attentionvote.measurement.scenes import MeasuredScenes
from attentionvote.registry.gates import Evidence, Gate, Rules, judge
from attentionvote.registry.history import History
from attentionvote.registry.logged_model import Figures
from attentionvote.registry.promotion import Standing, Superseded, move, stand
from attentionvote.registry.versions import DATA_FACT, Version, Versions
from attentionvote.workflows.evaluate.job import EvaluationJob
from attentionvote.workflows.evaluate.report import described, show
from attentionvote.workflows.settings import PromoteSettings

log = logging.getLogger("attentionvote.promote")


@dataclass(frozen=True)
class PromotionJob:
    """One candidate, and what it has to beat."""

    evaluation: EvaluationJob
    rules: Rules
    versions: Versions
    history: History
    standing: Standing
    why: str
    champion_key: str | None

    @classmethod
    def find(cls, cfg: PromoteSettings) -> PromotionJob:
        """The candidate that a configuration names, and where the champion stands.

        Raises:
            ValueError: when there is no bundle, or the registry cannot be used.
        """
        evaluation = EvaluationJob.find(cfg)
        if not evaluation.is_standard:
            raise ValueError(
                "a promotion must measure models as cells run them, on evaluation.split=evaluation, got another split, "
                "dataset or peak threshold: leave them out"
            )
        versions = Versions(cfg.tracking.store, evaluation.part.name)
        history = History(versions)
        standing = stand(versions, history)
        if standing.astray:
            log.warning("%s", standing.astray)
        return cls(evaluation, cfg.gates, versions, history, standing, cfg.why, cfg.champion_key)

    def already(self) -> dict[str, Any] | None:
        """The answer when the candidate is the champion by a decision of ours; None otherwise."""
        champion, bundle = self.standing.champion, self.evaluation.bundle
        if champion is None or champion.digest != bundle.digest or self.standing.astray:
            return None
        log.info("%s: bundle %s is the champion, version %d", self.name, bundle.digest[:12], champion.number)
        return self._answer(champion)

    @property
    def name(self) -> str:
        """Of the part."""
        return self.evaluation.part.name

    def run(self) -> dict[str, Any]:
        """Measure, judge, register, move.

        Raises:
            Refused: when a gate fails, or somebody else moved the champion meanwhile.
        """
        with tempfile.TemporaryDirectory(prefix="attentionvote-") as folder:
            champion, uncompared = self._champion(Path(folder))
            frozen = self.evaluation.evaluation_set()
            bundles = [self.evaluation.bundle, *([champion] if champion else [])]
            measured = self.evaluation.measure(bundles, frozen)
        report = described(self.evaluation, frozen, measured[0])
        show(report)
        evidence = [self._evidence(measurement) for measurement in measured]
        origin = self.versions.origin(self.evaluation.bundle.card.run_id, self.evaluation.signer)
        gates = judge(
            self.rules, evidence[0], evidence[1] if champion else None, self.evaluation.bundle.card, origin, len(frozen)
        )
        against = uncompared or f"against champion version {self.standing.champion.number}"  # type: ignore[union-attr]
        _show_gates(gates, against)
        failed = [gate for gate in gates if not gate.holds]
        facts = {f"gate.{gate.name}": str(gate) for gate in gates}
        facts |= {f"{DATA_FACT}{split}": digest for split, digest in self.evaluation.bundle.card.data.items()}
        facts |= {"evaluation.set": frozen.digest, "machine": report["machine"], "compared": against}
        headlines = {name: report["figures"][name] for name in HEADLINES if name in report["figures"]}
        numbers = {name: f"{value:.4f}" for name, value in headlines.items()}  # to sort the registry's pages by
        version = self.versions.register(
            self.evaluation.bundle,
            facts | numbers | {"decision": "refused" if failed else "passed"},
            Figures(headlines, frozen.digest, f"{self.name}/{self.evaluation.cfg.evaluation.split}"),
            self._description(report, headlines, gates),
        )
        answer = self._answer(version, report, gates, frozen)
        if failed:
            why = f"{len(failed)} of {len(gates)} gates failed: " + ", ".join(gate.name for gate in failed)
            before = self.standing.champion.number if self.standing.champion else None
            self.history.append("refuse", version.number, before, version.digest, self.standing.base, why, facts)
            raise Refused(
                f"{self.name} version {version.number} stays a candidate, because {why} (first: {failed[0].demands}, "
                f"got {failed[0].finding})",
                answer,
            )
        try:
            move(self.versions, self.history, self.standing, "promote", version, self.why, facts)
        except Superseded as error:
            self.versions.tag(version, {"decision": "superseded"})
            raise Refused(str(error), answer) from error
        self.versions.tag(version, {"decision": "promoted"})
        log.info("%s: version %d is the champion now%s", self.name, version.number, self._instead())
        return answer | {"promoted": True, "champion": version.number}

    def _description(self, report: Mapping[str, Any], headlines: Mapping[str, float], gates: Sequence[Gate]) -> str:
        """The version's page, in Markdown: figures with intervals, gates, how the model is loaded."""
        sure, card = report["intervals"], self.evaluation.bundle.card
        intervals = {name: "{:.3f} to {:.3f}".format(*sure[name]) for name in headlines if name in sure}
        rows = [f"| {name} | {value:.4f} | {intervals.get(name, '')} |" for name, value in headlines.items()]
        holding = sum(gate.holds for gate in gates)
        origin = f"run `{card.run_id}`, commit `{card.commit[:12]}`" if card.run_id else "no run"
        return "\n".join(
            [
                f"**{card.part.title or self.name}**, D = {1000 * card.part.diameter:.1f} mm; "
                f"{holding} of {len(gates)} gates hold.",
                "",
                f"| figure on {report['scenes']} scenes | value | 95 % interval |",
                "|---|---|---|",
                *rows,
                "",
                f"{report['sensor']}; measured on {report['machine']}; bundle `{report['bundle'][:12]}` of {origin}.",
                "",
                f'`mlflow.pyfunc.load_model("models:/{self.versions.name}@champion").predict(points)`, '
                "points (N, 3) in metres.",
            ]
        )

    def _champion(self, folder: Path) -> tuple[Bundle | None, str]:
        """The champion's bundle from the registry, or None and why nothing is compared.

        Raises:
            ConfigurationError: when there is a champion that cannot be measured, and what to do about it.
        """
        champion = self.standing.champion
        if champion is None:
            return None, "no champion" if self.standing.ever else "no champion yet"
        trusted = self.evaluation.key if self.champion_key is None else trusted_key(self.champion_key)
        try:
            bundle = self.versions.fetch(champion, folder, trusted)
        except ValueError as error:
            raise ConfigurationError(
                f"the champion, version {champion.number}, cannot be measured: {error}; `make rollback`, name its key "
                "with champion_key=..., or delete that version"
            ) from error
        if bundle.card.part.digest != self.evaluation.part.digest:
            log.warning("the champion, version %d, is of another form of the part and is not compared", champion.number)
            return None, f"champion version {champion.number} is of another form of the part: not compared"
        return bundle, ""

    def _evidence(self, measured: Measurement) -> Evidence:
        part = self.evaluation.part
        return Evidence(measured.figures(part), measured.left_out(part))

    def _instead(self) -> str:
        return f", instead of {self.standing.champion.number}" if self.standing.champion else ""

    def _answer(
        self,
        version: Version,
        report: Mapping[str, Any] | None = None,
        gates: Sequence[Gate] = (),
        frozen: MeasuredScenes | None = None,
    ) -> dict[str, Any]:
        """The dictionary of the JSON line while nothing is moved."""
        champion = self.standing.champion.number if self.standing.champion else None
        answer = {
            "stage": "promote",
            "object": self.name,
            "model": self.versions.name,
            "version": version.number,
            "bundle": version.digest,
            "promoted": False,
            "champion": champion,
            "before": champion,
        }
        if report is None or frozen is None:
            return answer
        return answer | {
            "gates": {
                gate.name: {"holds": gate.holds, "demands": gate.demands, "found": gate.finding} for gate in gates
            },
            "figures": report["figures"],
            "intervals": report["intervals"],
            "evaluation_set": frozen.digest,
        }


def _show_gates(gates: Sequence[Gate], against: str) -> None:
    marks = {True: "[green]holds[/]", False: "[bold red]FAILS[/]"}
    rows = [(marks[gate.holds], gate.name, gate.demands, gate.finding) for gate in gates]
    show_table(("", "gate", "demands", "found"), rows, f"gates, {against}")
