"""The proof of an export: every execution path against the checkpoint, what each costs, and the verdict."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from attentionvote.geometry import native
from attentionvote.inference import BundleError
from attentionvote.part import Parts

if TYPE_CHECKING:
    from attentionvote.contract import ModelCard
    from attentionvote.data.clouds import Clouds
    from attentionvote.export.parity_record import Limits, Parity
    from attentionvote.model.network import AttentionVote

log = logging.getLogger("attentionvote.export")
EAGER = "torch eager, neighbours given"
_ROUNDS = 7


def prove(
    model: AttentionVote, graph: bytes, card: ModelCard, part: Parts, clouds: Clouds, indices: Sequence[int]
) -> tuple[dict[str, Parity], dict[str, float]]:
    """Parity by execution path, and milliseconds a scene of checkpoint and graph, one thread each.

    Args:
        model: the network of the checkpoint.
        graph: the ONNX file.
        card: its card, without figures.
        part: for distances and symmetries; or the set of parts.
        clouds: of the held-out scenes.
        indices: of the scenes to compare.
    """
    import torch
    from rich.console import Console
    from rich.progress import track

    from attentionvote.export import held_out
    from attentionvote.export.parity import measure_parity
    from attentionvote.inference.runtime import Session, providers

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        batch = next(held_out.samples(clouds, list(indices[-1:]), card.points, model.layout))
        points, normals = batch.points.numpy(), batch.normals.numpy()
        # Sampling and neighbours are given to plain torch: the slow references of those would only flatter the graph.
        eager = partial(model, batch.points, batch.normals, batch.neighborhoods)
        work: dict[str, Callable[[], object]] = {
            "torch with C kernels": partial(model, batch.points, batch.normals),
            EAGER: native.disabled()(eager),
        }
        parity = {}
        for name, provider in providers().items():
            try:
                session = Session(graph, card, threads=1, provider=provider)
            except BundleError as error:
                if name == "CPU":
                    raise
                log.warning("%s is left out of the proof: %s", name, error)
                continue
            drawn = held_out.samples(clouds, list(indices), card.points, model.layout)
            shown = track(drawn, f"{part.name}: proof on {name}", len(indices), console=Console(stderr=True))
            thresholds = card.peak_threshold, card.confidence_threshold
            parity[name] = measure_parity(model, session.run, shown, part, *thresholds)
            work[name] = partial(session.run, points, normals)
        with torch.no_grad():
            return parity, _milliseconds(work)
    finally:
        torch.set_num_threads(threads)


def judge(parity: Mapping[str, Parity], limits: Limits, report: Path) -> None:
    """Say what was measured.

    Raises:
        ValueError: with every limit that is broken.
    """
    from attentionvote.export.parity_record import table

    for line in table(parity, limits):
        log.info(line)
    broken = [f"{name}: {sentence}" for name, p in parity.items() for sentence in p.violations(limits)]
    if broken:
        raise ValueError(
            f"graph and checkpoint must be equal within the limits, but {'; '.join(broken)}: "
            f"nothing is exported, the report is {report}"
        )


def _milliseconds(work: Mapping[str, Callable[[], object]]) -> dict[str, float]:
    """Least time of some rounds, which share the machine's load; processor time, but of a GPU path what passes."""
    taken: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(_ROUNDS + 1):
        for name, run in work.items():
            clock = time.process_time if name == "CPU" or name.startswith("torch") else time.perf_counter
            start = clock()
            run()
            taken[name].append(1000 * (clock() - start))
    least = {name: round(min(values[1:]), 2) for name, values in taken.items()}  # the first round warms up
    for name, value in least.items():
        log.info("one scene, one thread: %7.1f ms, %4.2f of eager  %s", value, value / least[EAGER], name)
    return least
