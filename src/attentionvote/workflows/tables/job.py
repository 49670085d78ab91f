"""A table of the paper from its settings to its page."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml  # type: ignore[import-untyped]

from attentionvote.command.conf_folder import CONF
from attentionvote.command.configuration import compose
from attentionvote.command.entry import configuring
from attentionvote.command.errors import ConfigurationError, Refused, sentence
from attentionvote.command.words import parse, words_beside, words_of
from attentionvote.workflows.chain import words_of_verbs
from attentionvote.workflows.evaluate.settings import EvaluateSettings
from attentionvote.workflows.tables.settings import TablesSettings

if TYPE_CHECKING:
    from attentionvote.workflows.tables.table import Row


log = logging.getLogger("attentionvote.benchmark")


IMAGES = "images"  # beside the page


RECORDED = CONF / "evaluation" / "benchmark.yaml"


def run(cfg: TablesSettings, words: Sequence[str]) -> dict[str, Any]:
    """Measure what can be measured of a table, and write it down.

    Args:
        cfg: the benchmark's configuration.
        words: it was composed of; those of the training are handed on.
    """
    from attentionvote.files import locked_folder
    from attentionvote.workflows.page_sections import put
    from attentionvote.workflows.tables.cells import CellFailed, cells_of_parts
    from attentionvote.workflows.tables.page import draw, markdown
    from attentionvote.workflows.tables.record import BenchmarkRecord
    from attentionvote.workflows.tables.table import BenchmarkTable

    with configuring():
        table = BenchmarkTable.of(table_name(words), cfg.composed["table"])
        objects, rows = table.select(cfg.objects, cfg.rows)
    if cfg.record:
        return record(cfg, [*objects, *(row.together for row in rows if row.together)])
    folder = Path(cfg.benchmarks)
    with locked_folder(folder, cfg.benchmarks, "benchmark", "benchmarks"):
        with configuring():
            page_record = BenchmarkRecord.beside(cfg.page, table.name)
        failures: dict[str, str] = {}
        left_out: dict[str, str] = {}
        for row in rows:
            for name in objects if row.together is None else (row.together,):
                try:
                    with configuring():
                        cell = _measure(cfg, words, row, name)
                    shown = {name: cell} if row.together is None else cells_of_parts(cell, objects)
                except (CellFailed, ConfigurationError) as error:
                    # A part without a mesh, say, is no failure where nobody asked for it by name.
                    unasked = isinstance(error, ConfigurationError) and cfg.objects is None
                    (left_out if unasked else failures)[f"{row.name}, {name}"] = sentence(error)
                    log.warning("%s, %s: %s", row.name, name, sentence(error))
                    continue
                for part, measured in shown.items():
                    if measured is not None:
                        page_record.add(row.name, part, measured)
                if cell is None:
                    log.info("%s, %s: not run (train=true trains it)", row.name, name)
        if cfg.page:
            page = Path(cfg.page)
            picture = f"{IMAGES}/{table.name}.png"
            drawn = table.curve is not None and draw(table, table.curve, page_record.cells, page.parent / picture)
            put(page, table.name, markdown(table, page_record.cells, picture if drawn else None))
            log.info("%s: written into %s", table.title, page)
    result = {
        "stage": "benchmark",
        "table": table.name,
        "cells": list(page_record.cells.values()),
        "failures": failures,
        "left_out": left_out,
        "page": cfg.page,
    }
    if failures:
        first = next(iter(failures.items()))
        raise Refused(f"{len(failures)} cells could not be measured (first: {first[0]}: {first[1]})", result)
    return result


def _measure(cfg: TablesSettings, words: Sequence[str], row: Row, name: str) -> dict[str, Any] | None:
    from attentionvote.execution.hardware import cores
    from attentionvote.workflows.tables.cells import baseline_cell, network_cell
    from attentionvote.workflows.tables.table import DETECTORS

    folder = Path(cfg.benchmarks)
    part = words_of(("object",), words)
    # What a benchmark exports is nobody's newest model.
    here = replace(
        cfg,
        export=(f"outputs={folder / 'export'}", *part, *cfg.export, *row.export),
        evaluate=(f"outputs={folder / 'evaluate'}", *part, *scene_words(words), *cfg.evaluate, *row.evaluate),
    )
    if row.detector == "network":
        verbs, _ = words_of_verbs(here, [*training_words(words, cfg.train), *row.train], name)
        return network_cell(verbs, name, cfg.train)
    # Where bundles lie and who signed them is nothing to the baseline.
    on = [f"root={cfg.root}", *here.evaluate, *(["force=true"] if cfg.force else [])]
    return baseline_cell(on, name, row, folder, cfg.baseline_workers or cores(), cfg.composed[DETECTORS[row.detector]])


def record(cfg: TablesSettings, objects: Sequence[str]) -> dict[str, Any]:
    """Generate the frozen scenes of these parts and write their digests into ``RECORDED``; no mesh, no scenes."""
    from attentionvote.files import write_whole
    from attentionvote.workflows.evaluate.frozen_set import generated_set, set_spec

    content = yaml.safe_load(RECORDED.read_text(encoding="utf-8"))
    frozen = dict(content.get("frozen", {}))
    for name in objects:
        evaluation = compose(
            EvaluateSettings, [f"object={name}", f"root={cfg.root}", "evaluation=benchmark", *cfg.evaluate]
        )
        try:
            with configuring():
                part = evaluation.object()
        except ConfigurationError as error:
            log.warning("%s: %s", name, error)
            continue
        frozen[name] = generated_set(evaluation, part, set_spec(evaluation, part)).scenes.digest
    head = "".join(line for line in RECORDED.read_text().splitlines(True) if line.startswith("#"))
    content["frozen"] = dict(sorted(frozen.items()))
    write_whole(RECORDED, head + yaml.safe_dump(content, sort_keys=False))
    return {"stage": "benchmark", "frozen": content["frozen"], "file": str(RECORDED)}


def table_name(words: Sequence[str]) -> str:
    """The chosen file of conf/table."""
    return next(word.partition("=")[2] for word in reversed(words) if word.startswith("table="))


def training_words(words: Sequence[str], train: bool) -> list[str]:
    """The words that are about the trainings, not about the benchmark, the machine's preset first.

    Args:
        words: all of them.
        train: whether trainings may be repeated: without it ``force`` is about measuring only, whoever sets it.

    Raises:
        ConfigurationError: when one names a single part.
    """
    if "object" in [str(override.key_or_group) for override in parse(words)]:
        raise ConfigurationError("a benchmark takes objects=NAME,NAME, got object=: say OBJECTS=...")
    handed_on = words_beside("benchmark", ("table", "evaluation"), words)
    return handed_on if train else [*handed_on, "force=false"]


def scene_words(words: Sequence[str]) -> list[str]:
    """The words that are about the scenes; the frozen ones unless others are named."""
    named = any(str(override.key_or_group) == "evaluation" for override in parse(words))
    return [*([] if named else ["evaluation=benchmark"]), *words_of(("evaluation",), words)]
