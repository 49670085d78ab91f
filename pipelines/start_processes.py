"""torchrun for people: one training on several processes of this machine, or of several machines.

    make train OBJECT=gear PROCESSES=8
    .venv/bin/python pipelines/start_processes.py --standalone --nproc-per-node=8 pipelines/train.py object=gear

Takes torchrun's arguments and does what torchrun does. When a process fails, its own sentence is the last word instead
of torchrun's traceback, and its exit code is kept: 2 for an impossible configuration, 130 for Ctrl-C, 143
for SIGTERM.
"""

from __future__ import annotations

import sys

from attentionvote.workflows.train.torchrun import main

if __name__ == "__main__":
    sys.exit(main())
