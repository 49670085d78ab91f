"""One part of a fleet: trained, exported, evaluated by the verbs themselves, each in a process of its own."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from attentionvote.execution.job_process import JobProcess

VERBS = ("train", "export", "evaluate")
SCRIPTS = Path(__file__).resolve().parent


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
            chosen = [f"run={answers['train']['run_id']}"] if verb == "export" else []
            if verb == "evaluate":
                chosen = [f"bundle='{Path(answers['export']['bundle']).name}'"]
            outcome = self._run(verb, [f"object={name}", *self.words[verb], *chosen], name)
            if outcome.result is None:
                answers |= {"failed": verb, "sentence": outcome.sentence}
                break
            answers[verb] = outcome.result
        return answers | {"seconds": round(time.monotonic() - start, 1)}

    def _run(self, verb: str, words: list[str], name: str) -> Any:
        script = self.scripts / f"{verb}.py"
        if self.logs is None:
            return JobProcess(script, words, environment=self.environment).wait()
        self.logs.mkdir(parents=True, exist_ok=True)
        with (self.logs / f"{name}-{verb}.log").open("ab") as log:
            return JobProcess(script, words, log, self.environment).wait()
