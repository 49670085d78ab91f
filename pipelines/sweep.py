"""Search the settings that train best: trials are ordinary trainings, judged by val/ap of their best checkpoint.

    make sweep OBJECT=connecting_rod TRIALS=30 [ARGS="workers=2 trainer.max_epochs=12 save_as=rod"]

The space is a file of conf/sweep/. Stopped, also by kill -9, the same command goes on; TRIALS is what the study shall
have in all. With executor=ray or executor=slurm the trials run on other machines (docs/scaling.md). The best settings
are an experiment afterwards: make train OBJECT=connecting_rod ARGS=experiment=rod.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from attentionvote.command.conf_folder import choices, primary_groups
from attentionvote.command.configuration import compose
from attentionvote.command.entry import command, configuring
from attentionvote.command.words import words_beside, words_of
from attentionvote.workflows.sweep.settings import SweepSettings
from attentionvote.workflows.train.preset import preset_of_workers

_WHERE = ("executor", "cluster")  # settings that say where trials run


def run(cfg: SweepSettings) -> dict[str, Any]:
    """Bring the study to its total; its best trial.

    Args:
        cfg: the sweep's configuration, whose words about the training are handed on to the trials.
    """
    from attentionvote.files import locked_folder
    from attentionvote.workflows.sweep.job import SweepJob
    from attentionvote.workflows.sweep.report import check_save_as

    check_save_as(cfg.save_as, words=cfg.words)
    with configuring():
        job = SweepJob(cfg, training_words(cfg.words), _space_name(cfg.words))
    with locked_folder(job.folder, cfg.sweeps, "sweep", "sweeps"):
        with configuring():
            job.open()
        return job.run()


def training_words(words: Sequence[str]) -> list[str]:
    """The words that are about the trainings, not about the sweep."""
    return words_beside("sweep", ("sweep", "workers", "force", "resume", *_WHERE), words)


def preset_of_trials(words: Sequence[str]) -> list[str]:
    """The preset of the machines that train, told by the words that say which these are."""
    where = words_of(_WHERE, words)
    return preset_of_workers(compose(SweepSettings, [f"object={choices('object')[0]}", *where]), words)


def _space_name(words: Sequence[str]) -> str:
    """The chosen file of conf/sweep."""
    names = [word.partition("=")[2] for word in words if word.lstrip("+").startswith("sweep=")]
    return names[-1] if names else str(primary_groups("sweep")["sweep"])


def check(cfg: SweepSettings) -> None:
    """What a grid of sweeps asks of each before the first starts."""
    from attentionvote.workflows.sweep.space import parse_space

    parse_space(cfg.composed["sweep"]["space"], cfg)


if __name__ == "__main__":
    command(SweepSettings, run, defaults=preset_of_trials, check=check)
