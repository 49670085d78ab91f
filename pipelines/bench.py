"""Measure every fast path beside its references, in the same run, and compare their results (docs/speed.md).

make bench [ROWS=ball-query,normals ARGS="rounds=7 page=''"]

Figures go to stdout as one JSON object and into docs/benchmarks.md. A row whose results differ is an error; one that
misses its goal is not.
"""

from __future__ import annotations

import os

from attentionvote.workflows.speed.settings import SpeedSettings

# Before numpy is imported: its threads would count as processor time of one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from attentionvote.command.entry import command
from attentionvote.workflows.speed.job import run

if __name__ == "__main__":
    command(SpeedSettings, run)
