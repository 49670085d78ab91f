"""Settings of a table of the paper: ``conf/benchmark.yaml``, those of a training among them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from attentionvote.baselines.settings import FpfhSettings, PpfSettings
from attentionvote.command.sections import EvaluationSettings
from attentionvote.setting import Setting
from attentionvote.workflows.train.settings import TrainSettings


@dataclass(frozen=True)
class TableFile:
    """A file of ``conf/table``, whose rows ``BenchmarkTable`` checks."""

    title: Annotated[str, Setting("Over the table.")]
    figures: Annotated[tuple[str, ...], Setting("Of each object, e.g. ap_10.")]
    objects: Annotated[tuple[str, ...], Setting("Parts, the columns.")]
    curve: Annotated[dict[str, Any] | None, Setting("Of a figure: its axes; null = a table.")]
    measured: Annotated[Any, Setting("Rows of ours.")]
    paper: Annotated[Any, Setting("Rows of the paper.")]


@dataclass(frozen=True, kw_only=True)
class TablesSettings(TrainSettings):
    """Which rows and objects of a table are measured, and where they are written."""

    verb: ClassVar[str] = "benchmark"
    table: TableFile
    evaluation: EvaluationSettings
    objects: Annotated[str | None, Setting("Names with commas between them; null = the table's.")]
    rows: Annotated[str | None, Setting("Rows to measure, names with commas between; null = all.")]
    train: Annotated[bool, Setting('Train what is not trained yet; without it such cells are "not run".')]
    export: Annotated[tuple[str, ...], Setting("Words for the exports.", empty=True)]
    evaluate: Annotated[tuple[str, ...], Setting("Words for the evaluations.", empty=True)]
    baseline_workers: Annotated[
        int | None, Setting("Processes of the classical baselines; null = one per core.", low=1, high=1024)
    ]
    ppf: PpfSettings
    fpfh: FpfhSettings
    benchmarks: Annotated[str, Setting("Where models and evaluations lie.")]
    page: Annotated[str, Setting("Page whose tables are written; page='' = none.")]
    record: Annotated[bool, Setting("Record the digests of the frozen scenes instead of measuring.")]
