"""Export a trained model: one ONNX graph, proved equal to its checkpoint in task units, in a signed bundle.

    make export OBJECT=connecting_rod [RUN=...]

Takes the newest complete training of the part. Writes outputs/export/OBJECT/DIGEST and points `latest` at it; when
graph and checkpoint differ by more than `limits`, only the report is written and the exit code is 1. The signing key
is made on first use; the cell needs its public half (docs/operating-a-cell.md).
"""

from __future__ import annotations

from typing import Any

from attentionvote.command.entry import command, configuring
from attentionvote.workflows.settings import ExportSettings


def run(cfg: ExportSettings) -> dict[str, Any]:
    """Export, prove, sign; where the bundle is and what the proof measured."""
    from attentionvote.workflows.export import ExportJob

    with configuring():
        job = ExportJob.find(cfg)
    with job.locked():
        result = job.done()
        if result is None:
            with configuring():
                work = job.prepare()
            result = work.run()
    return result


if __name__ == "__main__":
    command(ExportSettings, run)
