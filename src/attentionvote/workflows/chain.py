"""One part of a fleet: trained, exported, evaluated by the verbs themselves, each in a process of its own."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attentionvote.command.conf_folder import SCRIPTS
from attentionvote.command.configuration import compose
from attentionvote.execution.job_process import JobProcess
from attentionvote.workflows.evaluate.settings import EvaluateSettings
from attentionvote.workflows.settings import ExportSettings
from attentionvote.workflows.train.settings import TrainSettings

if TYPE_CHECKING:
    from attentionvote.workflows.fleet.settings import FleetSettings
    from attentionvote.workflows.tables.settings import TablesSettings

VERBS = ("train", "export", "evaluate")


@dataclass(frozen=True)
class MemberTask:
    """Runs the verbs of a part; the task that the executor takes to its workers.

    Args:
        words: of every verb.
        logs: folder for what the verbs say; None shows it here.
        scripts: folder of the verbs.
        environment: further variables of their processes.
    """

    words: dict[str, tuple[str, ...]]
    logs: Path | None
    scripts: Path = SCRIPTS
    environment: Mapping[str, str] = field(default_factory=dict, repr=False)

    def __call__(self, name: str) -> dict[str, Any]:
        """What the verbs answered, by verb; ``failed`` names the verb that did not, ``sentence`` says why."""
        start = time.monotonic()
        answers: dict[str, Any] = {}
        for verb in VERBS:
            # The training that these words mean and its bundle, not the newest ones.
            selected = [f"run={answers['train']['run_id']}"] if verb == "export" else []
            if verb == "evaluate":
                selected = [f"bundle='{Path(answers['export']['bundle']).name}'"]
            outcome = self._run(verb, [f"object={name}", *self.words[verb], *selected], name)
            if outcome.result is None:
                answers |= {"failed": verb, "sentence": outcome.sentence}
                break
            answers[verb] = outcome.result
        return answers | {"seconds": round(time.monotonic() - start, 1)}

    def _run(self, verb: str, words: list[str], name: str) -> Any:
        script = self.scripts / f"{verb}.py"
        if self.logs is None:
            return JobProcess(script, words, environment=self.environment).result()
        self.logs.mkdir(parents=True, exist_ok=True)
        with (self.logs / f"{name}-{verb}.log").open("ab") as log:
            return JobProcess(script, words, log, self.environment).result()


def words_of_verbs(
    cfg: FleetSettings | TablesSettings, training: Sequence[str], name: str
) -> tuple[dict[str, tuple[str, ...]], dict[str, Path]]:
    """The words of every verb, and where bundles lie; all are composed once, so that a wrong one is said before work.

    Exports and evaluations lie beside the trainings: ``outputs/train`` has ``outputs/export`` as its neighbour.
    """
    beside = Path(cfg.outputs).parent
    said = {"export": list(cfg.export), "evaluate": list(cfg.evaluate)}
    export = [f"trained={cfg.outputs}", f"root={cfg.root}", f"outputs={beside / 'export'}", *said["export"]]
    exported = compose(ExportSettings, [f"object={name}", *export])
    evaluate = [f"root={cfg.root}", f"bundles={exported.outputs}", f"outputs={beside / 'evaluate'}"]
    if cfg.tracking.store is not None:
        evaluate.append(f"tracking.store={cfg.tracking.store}")
    if exported.signing_keys is not None:
        evaluate.append(f"trusted_key={exported.signing_keys}/signing.pub")
    evaluate += said["evaluate"]
    compose(EvaluateSettings, [f"object={name}", *evaluate])
    compose(TrainSettings, [f"object={name}", *training])
    words = {"train": tuple(training), "export": tuple(export), "evaluate": tuple(evaluate)}
    return words, {"bundles": Path(exported.outputs)}
