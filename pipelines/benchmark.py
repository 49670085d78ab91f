"""Measure a table or figure of the paper: the paper's numbers, ours, and a baseline's on the same scenes.

    make benchmark TABLE=6 [OBJECTS=connecting_rod,gear ARGS="train=true trainer.max_epochs=12 rows=ours"]

TABLE is 3 to 9, fig8 or fig11 (conf/table/). What is trained already is exported, evaluated on the benchmark's frozen
scenes and written into docs/benchmarks.md; train=true also trains what is missing; the rest says "not run". Settings
are those of train, and those of the scenes: evaluation.dataset=DIR takes your copy of a dataset.
"""

from __future__ import annotations

from attentionvote.command.entry import command
from attentionvote.workflows.tables.job import run
from attentionvote.workflows.tables.settings import TablesSettings
from attentionvote.workflows.train.preset import preset_of_hardware

if __name__ == "__main__":
    composed_words: list[str] = []

    def presets(words: list[str]) -> list[str]:
        """The preset of this machine, chosen and said once."""
        machine = preset_of_hardware(words)
        composed_words[:] = [*machine, *words]
        return machine

    command(TablesSettings, lambda cfg: run(cfg, composed_words), defaults=presets)
