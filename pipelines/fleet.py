"""One model a part: train, export and evaluate every part, and a leaderboard of all of them.

    make fleet OBJECTS=all [ARGS="experiment=paper workers=2"]

OBJECTS is a list such as gear,brick, or all: every part whose mesh is there. The settings are those of train. A part
that fails does not stop the others; the exit code is 1 then. Stopped, also by kill -9, the same command goes on, and
what is done is not done again. With executor=ray or executor=slurm the parts go to other machines (docs/scaling.md).
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig
from train import preset_of_workers

from attentionvote.command.conf_folder import choices
from attentionvote.command.configuration import compose
from attentionvote.command.entry import command, configuring
from attentionvote.command.errors import ConfigurationError, Refused, nearest, sentence
from attentionvote.command.words import parse, words_beside
from attentionvote.part import only_part

if TYPE_CHECKING:
    from fleet_member import MemberTask
    from training_job import TrainingJob

    from attentionvote.execution import Executor

log = logging.getLogger("attentionvote.fleet")


def run(cfg: DictConfig, words: Sequence[str]) -> dict[str, Any]:
    """Bring every part to its evaluation; the leaderboard.

    Args:
        cfg: the fleet's configuration.
        words: it was composed of; those of the training are handed on to every part.
    """
    import fleet_board
    from fleet_member import MemberTask

    from attentionvote.command.executors import cores_of_a_job, executor_of
    from attentionvote.execution.job_process import handed_on
    from attentionvote.files import locked_folder

    training = [*preset_of_workers(cfg, words), *training_words(words)]
    with configuring():
        executor = executor_of(cfg)
    jobs, left_out = members(cfg.objects, training)
    for name, reason in left_out.items():
        log.warning("%s is left out: %s", name, reason)
    workers = cfg.workers or 1
    threads = cores_of_a_job(cfg, workers)
    folder = Path(cfg.fleets)
    here = cfg.executor == "local" and workers == 1
    own = () if here else (f"workers={threads}", f"trainer.threads={threads}")
    # The user's words come last: a number of threads that was asked for is kept.
    member_words, places = words_of_verbs(cfg, (*own, *training), next(iter(jobs)))
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
    failures = {known["object"]: known["failed"] for known in rows if known["failed"]}
    log.info("%d of %d parts are done: %s", len(rows) - len(failures), len(rows), board)
    result = {
        "stage": "fleet",
        "members": rows,
        "left_out": left_out,
        "failures": failures,
        "leaderboard": str(board),
    }
    if failures:
        told = "; ".join(f"{name} failed, {reason}" for name, reason in failures.items())
        raise Refused(f"{len(failures)} of {len(rows)} parts are not done: {told}", result)
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
    from training_job import find_training

    known = choices("object")
    everything = objects == "all"
    named = known if everything else [name.strip() for name in objects.split(",") if name.strip()]
    for name in named:
        if name not in known:
            raise ConfigurationError(
                f"objects must be all or among {', '.join(known)}; got {name!r}{nearest(name, known)}"
            )
    jobs: dict[str, TrainingJob] = {}
    left_out: dict[str, str] = {}
    for name in dict.fromkeys(named):
        cfg = compose("train", [f"object={name}", *training])
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


def words_of_verbs(
    cfg: DictConfig, training: Sequence[str], name: str
) -> tuple[dict[str, tuple[str, ...]], dict[str, Path]]:
    """The words of every verb, and where bundles lie; all are composed once, so that a wrong one is said before work.

    Exports and evaluations lie beside the trainings: ``outputs/train`` has ``outputs/export`` as its neighbour.
    """
    beside = Path(cfg.outputs).parent
    said = {"export": list(cfg.export), "evaluate": list(cfg.evaluate)}
    export = [f"trained={cfg.outputs}", f"root={cfg.root}", f"outputs={beside / 'export'}", *said["export"]]
    exported = compose("export", [f"object={name}", *export])
    evaluate = [f"root={cfg.root}", f"bundles={exported.outputs}", f"outputs={beside / 'evaluate'}"]
    if cfg.tracking.store is not None:
        evaluate.append(f"tracking.store={cfg.tracking.store}")
    if exported.signing_keys is not None:
        evaluate.append(f"trusted_key={exported.signing_keys}/signing.pub")
    evaluate += said["evaluate"]
    compose("evaluate", [f"object={name}", *evaluate])
    compose("train", [f"object={name}", *training])
    words = {"train": tuple(training), "export": tuple(export), "evaluate": tuple(evaluate)}
    return words, {"bundles": Path(exported.outputs)}


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
                    told = f"failed, {answer['sentence']}" if answer.get("failed") else "done"
                    log.info(
                        "%s (%d of %d): %s, %.0f s", left[index], len(answers), len(names), told, answer["seconds"]
                    )
        except WorkerDied as error:
            name = left[error.job]
            answers[name] = {"failed": "worker", "sentence": f"it died {error.times} times ({error.how})"}
            log.info("%s (%d of %d): %s", name, len(answers), len(names), answers[name]["sentence"])
    return answers


if __name__ == "__main__":
    preset: list[str] = []

    def presets(words: list[str]) -> list[str]:
        """The preset of the trainings, chosen and said once."""
        preset[:] = preset_of_workers(compose("fleet", words), words)
        return preset

    command("fleet", lambda cfg: run(cfg, [*preset, *sys.argv[1:]]), defaults=presets)
