"""One model a part: train, export and evaluate every part, and a leaderboard of all of them.

    make fleet OBJECTS=all [ARGS="experiment=paper workers=2"]

OBJECTS is a list such as gear,brick, or all: every part whose mesh is there. The settings are those of train. A part
that fails does not stop the others; the exit code is 1 then. Stopped, also by kill -9, the same command goes on, and
what is done is not done again. With executor=ray or executor=slurm the parts go to other machines (docs/scaling.md).
"""

from __future__ import annotations

from attentionvote.command.configuration import compose
from attentionvote.command.entry import command
from attentionvote.workflows.fleet.job import run
from attentionvote.workflows.fleet.settings import FleetSettings
from attentionvote.workflows.train.preset import preset_of_workers

if __name__ == "__main__":
    command(FleetSettings, run, defaults=lambda words: preset_of_workers(compose(FleetSettings, words), words))
