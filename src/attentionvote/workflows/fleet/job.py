"""A fleet from its settings to its leaderboard."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attentionvote.command.conf_folder import choices
from attentionvote.command.configuration import compose
from attentionvote.command.entry import configuring
from attentionvote.command.errors import ConfigurationError, Refused, nearest, sentence
from attentionvote.command.words import parse, words_beside
from attentionvote.part import only_part
from attentionvote.workflows.chain import words_of_verbs
from attentionvote.workflows.fleet.settings import FleetSettings
from attentionvote.workflows.train.preset import preset_of_workers
from attentionvote.workflows.train.settings import TrainSettings

if TYPE_CHECKING:
    from attentionvote.execution import Executor
    from attentionvote.workflows.chain import MemberTask
    from attentionvote.workflows.train.job import TrainingJob


log = logging.getLogger("attentionvote.fleet")


def run(cfg: FleetSettings) -> dict[str, Any]:
    """Bring every part to its evaluation; the leaderboard.

    Args:
        cfg: the fleet's configuration, whose words about the training are handed on to every part.
    """
    from attentionvote.command.executors import cores_of_a_job, executor_of
    from attentionvote.execution.job_process import handed_on
    from attentionvote.files import locked_folder
    from attentionvote.workflows.chain import MemberTask
    from attentionvote.workflows.fleet import board as fleet_board

    training = [*preset_of_workers(cfg, cfg.words), *training_words(cfg.words)]
    with configuring():
        executor = executor_of(cfg)
    jobs, left_out = members(cfg.objects, training)
    for name, reason in left_out.items():
        log.warning("%s is left out: %s", name, reason)
    workers = cfg.workers or 1
    threads = cores_of_a_job(cfg.threads, cfg.executor, workers)
    folder = Path(cfg.fleets)
    here = cfg.executor == "local" and workers == 1
    core_words = () if here else (f"workers={threads}", f"trainer.threads={threads}")
    # The user's words come last: a number of threads that was asked for is kept.
    member_words, places = words_of_verbs(cfg, (*core_words, *training), next(iter(jobs)))
    task = MemberTask(member_words, None if here else folder / "logs", environment=handed_on())
    with locked_folder(folder, cfg.fleets, "fleet", "fleets"):
        answers = _run(task, list(jobs), executor, workers, cfg.retries, threads)
        rows = [
            fleet_board.row(name, jobs[name], answers[name], places["bundles"], Path(cfg.root), cfg.tracking.store)
            for name in jobs
        ]
        rows = fleet_board.best_first(rows)
        board = fleet_board.write(folder, rows, left_out)
    fleet_board.show(rows)
    failures = {row["object"]: row["failed"] for row in rows if row["failed"]}
    log.info("%d of %d parts are done: %s", len(rows) - len(failures), len(rows), board)
    result = {
        "stage": "fleet",
        "members": rows,
        "left_out": left_out,
        "failures": failures,
        "leaderboard": str(board),
    }
    if failures:
        reasons = "; ".join(f"{name} failed, {reason}" for name, reason in failures.items())
        raise Refused(f"{len(failures)} of {len(rows)} parts are not done: {reasons}", result)
    return result


def training_words(words: Sequence[str]) -> list[str]:
    """The words that are about the trainings, not about the fleet.

    Raises:
        ConfigurationError: when one names a single part.
    """
    if "object" in [str(override.key_or_group) for override in parse(words)]:
        raise ConfigurationError("a fleet takes objects=NAME,NAME or objects=all, got object=: say OBJECTS=...")
    return words_beside("fleet", ("workers", "executor", "cluster"), words)


def members(objects: str, training: Sequence[str]) -> tuple[dict[str, TrainingJob], dict[str, str]]:
    """The trainings of a fleet by part, and the parts that are left out with the reason.

    Raises:
        ConfigurationError: a part that was named cannot be trained, or none is left.
    """
    from attentionvote.workflows.train.job import find_training

    valid = choices("object")
    everything = objects == "all"
    named = valid if everything else [name.strip() for name in objects.split(",") if name.strip()]
    for name in named:
        if name not in valid:
            raise ConfigurationError(
                f"objects must be all or among {', '.join(valid)}; got {name!r}{nearest(name, valid)}"
            )
    jobs: dict[str, TrainingJob] = {}
    left_out: dict[str, str] = {}
    for name in dict.fromkeys(named):
        cfg = compose(TrainSettings, [f"object={name}", *training])
        try:
            with configuring():
                job = find_training(cfg)
                if everything:  # a set's parts come by themselves
                    only_part(job.part, "objects=all")
                jobs[name] = job
        except ConfigurationError as error:
            left_out[name] = sentence(error)
        if name in left_out and not everything:
            raise ConfigurationError(f"object {name}: {left_out[name]}")
    if not jobs:
        raise ConfigurationError(f"objects={objects} must leave one part that can be trained, got none: {left_out}")
    return jobs, left_out


def _run(
    task: MemberTask, names: Sequence[str], executor: Executor, workers: int, retries: int, threads: int
) -> dict[str, Mapping[str, Any]]:
    """What the verbs of every part answered; a part that ends its workers again and again is one that failed."""
    from attentionvote.execution import WorkerDied, run_all

    answers: dict[str, Mapping[str, Any]] = {}
    while left := [name for name in names if name not in answers]:
        try:
            with closing(run_all(task, left, executor, workers=workers, retries=retries, threads=threads)) as results:
                for index, answer in results:
                    answers[left[index]] = answer
                    ending = f"failed, {answer['sentence']}" if answer.get("failed") else "done"
                    log.info(
                        "%s (%d of %d): %s, %.0f s", left[index], len(answers), len(names), ending, answer["seconds"]
                    )
        except WorkerDied as error:
            name = left[error.job]
            answers[name] = {"failed": "worker", "sentence": f"it died {error.times} times ({error.how})"}
            log.info("%s (%d of %d): %s", name, len(answers), len(names), answers[name]["sentence"])
    return answers
