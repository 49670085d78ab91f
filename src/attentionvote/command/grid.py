"""A grid (``-m``): every job checked before the first starts, each in a process of its own, one failure no end.

Hydra's grammar makes the jobs, but its launcher does not run them: it stops at the first failure, hides it until the
end, and its folders are named by the second. A job's results lie where the verb puts them, by its configuration.

Where jobs are tracked, one MLflow run stands above theirs: in the experiment of the part when all jobs are of one
part, else in the experiment ``grids``. The same grid run again finds it again.
"""

from __future__ import annotations

import hashlib
import json
import logging
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from omegaconf import OmegaConf

from attentionvote.command.configuration import Settings, VerbSettings
from attentionvote.command.errors import ConfigurationError
from attentionvote.command.words import parse
from attentionvote.execution.job_process import INTERRUPTED, JobProcess, Outcome

log = logging.getLogger("attentionvote.multirun")
Compose = Callable[[Sequence[str]], Settings]
Check = Callable[[Settings], object]
SEVERAL = "grids"  # the experiment of a grid over several parts


def run_grid(
    verb: str,
    words: Sequence[str],
    machine: Sequence[str],
    flags: Sequence[str],
    compose: Compose[Settings],
    check: Check[Settings] | None,
) -> None:
    """Run all jobs of a grid, one after the other; a JSON object a job on stdout.

    Args:
        verb: for sentences.
        words: what the user said, without ``-m``; several values with commas between them, or ``range(...)``.
        machine: overrides that stand for the machine's default.
        flags: that every job is started with.
        compose: the checked configuration of a job's words.
        check: raises ConfigurationError when a job cannot work.

    Raises:
        ConfigurationError: when a job is impossible; then none has started.
        SystemExit: 1 when a job failed, after all have run.
    """
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper

    parsed = parse([*machine, *words])
    for override in parsed:
        if override.key_or_group.split("/")[0].split(".")[0] == "hydra":
            raise ConfigurationError(
                f"a grid takes no settings of Hydra itself, got {override.input_line!r}: "
                "its jobs are run by the verb, in processes of their own"
            )
    jobs: list[list[str]] = [list(job) for job in BasicSweeper.split_arguments(parsed, None)[0]]
    configurations = []
    for job in jobs:
        configurations.append(compose(job))
        if check is not None:
            check(configurations[-1])
    title = " ".join(str(o.input_line) for o in parsed if o.is_sweep_override()) or " ".join(words)
    parent = _open_parent(verb, title, jobs, configurations)
    outcomes: list[Outcome] = []
    try:
        for index, job in enumerate(jobs):
            log.info("%s %d of %d: %s", verb, index + 1, len(jobs), " ".join(_distinct_words(job, jobs)))
            outcomes.append(_run_job(job, flags, parent))
            if outcomes[-1].code == INTERRUPTED:
                raise KeyboardInterrupt
    except BaseException as error:
        _close(parent, jobs, outcomes, error)
        raise
    _close(parent, jobs, outcomes, None)
    failed = [(job, outcome.sentence) for job, outcome in zip(jobs, outcomes, strict=True) if outcome.result is None]
    if failed:
        _leave_with(verb, failed, jobs)


def _run_job(job: Sequence[str], flags: Sequence[str], parent: Any) -> Outcome:
    below = [] if parent is None else [f"tracking.parent={parent.id}"]
    outcome = JobProcess(sys.argv[0], [*flags, *job, *below]).result()
    if outcome.code != INTERRUPTED:
        answer = outcome.result if outcome.result is not None else {"failed": outcome.sentence}
        print(json.dumps({"overrides": list(job), **answer}), flush=True)
    if parent is not None and outcome.result is not None and outcome.result.get("run_id"):
        from attentionvote.tracking.group_run import adopt

        # A job that was complete before the grid has a run already.
        adopt(parent.store, parent.id, outcome.result["run_id"], {})
    return outcome


def _open_parent(verb: str, title: str, jobs: Sequence[Sequence[str]], configurations: Sequence[VerbSettings]) -> Any:
    """The run above the jobs; None for a verb that tracks nothing."""
    first = configurations[0].composed
    tracking = first.get("tracking", {})
    if "parent" not in tracking:
        return None
    from attentionvote.command.identity import identity
    from attentionvote.tracking.group_run import open_group

    # How the jobs are run is not what they are.
    contents = [json.dumps(identity(configuration, once=True), sort_keys=True) for configuration in configurations]
    digest = hashlib.sha256("\n".join([verb, *sorted(contents)]).encode()).hexdigest()
    parts = {configuration.composed["object"]["name"] for configuration in configurations}
    run = open_group(
        tracking["store"],
        parts.pop() if len(parts) == 1 else SEVERAL,
        f"{verb} {title}"[:250],
        digest,
        parent=tracking["parent"],
        tags={"grid.overrides": title, "grid.jobs": len(jobs)},
        config_yaml=OmegaConf.to_yaml(OmegaConf.create([list(job) for job in jobs])),
    )
    log.info("%d jobs; the run above theirs: %s", len(jobs), run.url_hint)
    return run


def _close(
    parent: Any, jobs: Sequence[Sequence[str]], outcomes: Sequence[Outcome], error: BaseException | None
) -> None:
    if parent is None:
        return
    done = [
        {"overrides": list(job), "failed": outcome.sentence or None, "run_id": (outcome.result or {}).get("run_id")}
        for job, outcome in zip(jobs, outcomes, strict=False)
    ]
    parent.log_text("jobs.json", json.dumps(done, indent=2) + "\n")
    failed = sum(outcome.result is None for outcome in outcomes)
    parent.log_tags({"grid.failed": failed, "grid.done": len(outcomes) - failed})
    interrupted = isinstance(error, KeyboardInterrupt)
    parent.close("KILLED" if interrupted else "FAILED" if error is not None or failed else "FINISHED")


def _distinct_words(job: Sequence[str], jobs: Sequence[Sequence[str]]) -> list[str]:
    """The words that not all jobs have; all of them when the jobs are equal."""
    return [word for word in job if not all(word in other for other in jobs)] or list(job)


def _leave_with(verb: str, failed: Sequence[tuple[Sequence[str], str]], jobs: Sequence[Sequence[str]]) -> NoReturn:
    print(f"{verb}: {len(failed)} of {len(jobs)} jobs failed:", file=sys.stderr)
    for job, sentence in failed:
        print(f"  {' '.join(_distinct_words(job, jobs))}: {sentence}", file=sys.stderr)
    sys.stderr.flush()
    raise SystemExit(1)
