"""The process of a trial whose training runs on another machine: hands it to the executor and passes on its answer.

To the sweep it is what a training's own process is: the JSON line on stdout, the exit code, a sentence on failure. When
worker or training died, it ends by SIGKILL too, so that the trial is taken up again. When it is ended, so is the
training. The sweep starts it; the words after it are those of the training.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

from attentionvote.command.errors import sentence
from attentionvote.execution import WorkerDied, executor_named, run_all
from attentionvote.execution.job_process import INTERRUPTED, Outcome, handed_on, join_starter, report_failure
from attentionvote.files import locked_folder
from attentionvote.workflows.sweep.trial_place import VARIABLE, WORKER
from attentionvote.workflows.sweep.trial_task import TrialTask


def main() -> int:
    """Do the trial of the environment; the exit code."""
    join_starter()
    about = json.loads(os.environ.pop(WORKER))
    number: int = json.loads(os.environ[VARIABLE])["number"]
    try:
        outcome = _run(about, number, tuple(sys.argv[1:]))
    except KeyboardInterrupt:
        return INTERRUPTED
    except WorkerDied as error:
        outcome = Outcome(-signal.SIGKILL, None, f"its worker died ({error.how})")
    except Exception as error:
        outcome = Outcome(1, None, sentence(error))
    if outcome.result is not None:
        print(json.dumps(outcome.result), flush=True)
        return 0
    report_failure(outcome.sentence)
    # Ctrl-C there is not ours: the machine was taken away.
    if outcome.code < 0 or outcome.code == INTERRUPTED:
        os.kill(os.getpid(), signal.SIGKILL)
    return outcome.code


def _run(about: dict[str, Any], number: int, words: tuple[str, ...]) -> Outcome:
    executor = executor_named(about["executor"], about["cluster"])
    log = Path(about["log"]).absolute()
    task = TrialTask(Path(about["script"]), words, handed_on(), log, log.with_suffix(""))
    with locked_folder(task.claim, str(task.claim), "trial", "sweeps"):
        ((_, outcome),) = run_all(task, [number], executor, retries=0, threads=about["threads"])
    return outcome


if __name__ == "__main__":
    sys.exit(main())
