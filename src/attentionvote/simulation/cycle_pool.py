"""Drop cycles of a scene set, simulated here, in several processes or on several machines, with a progress bar.

Workers simulate, whoever asks stores: a cycle is a few kilobytes, so no worker needs the set's directory, and nothing
is written twice or by two.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property

from attentionvote.execution import Executor, WorkerDied, run_all
from attentionvote.part import Parts
from attentionvote.simulation.cycle import simulate_cycle
from attentionvote.simulation.drop import Solid
from attentionvote.simulation.raycast import PartCaster
from attentionvote.simulation.scene_record import SceneRecord
from attentionvote.simulation.scene_spec import SceneSetSpec


@dataclass(frozen=True)
class CycleTask:
    """Simulates a cycle; a worker builds the ray caster for its first one."""

    part: Parts
    solids: Sequence[Solid]
    spec: SceneSetSpec

    def __call__(self, cycle: int) -> list[SceneRecord]:
        """The scenes of a cycle."""
        return simulate_cycle(self.part, self.solids, self._caster, self.spec, cycle)

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in self.__dict__.items() if name != "_caster"}

    @cached_property
    def _caster(self) -> PartCaster:
        return PartCaster(self.part)


def run_cycles(
    part: Parts,
    solids: Sequence[Solid],
    spec: SceneSetSpec,
    cycles: Sequence[int],
    workers: int,
    progress: bool,
    title: str,
    done: int = 0,
    executor: Executor | None = None,
) -> Iterator[tuple[int, list[SceneRecord]]]:
    """Simulate ``cycles``, of which ``done`` were there before; yields each with its scenes as they come.

    Raises:
        OSError: when the worker of one cycle died again and again.
    """
    if not cycles:
        return
    simulated = _simulated(CycleTask(part, solids, spec), cycles, workers, executor)
    if not progress:
        yield from simulated
        return
    from rich import progress as rich
    from rich.console import Console

    columns = (
        rich.TextColumn("{task.description}"),
        rich.BarColumn(),
        rich.MofNCompleteColumn(),
        rich.TextColumn("cycles, {task.fields[scenes]} new scenes"),
        rich.TimeElapsedColumn(),
        rich.TextColumn("left"),
        rich.TimeRemainingColumn(),
    )
    with rich.Progress(*columns, console=Console(stderr=True), speed_estimate_period=120) as bar:
        task = bar.add_task(title, total=done + len(cycles), completed=done, scenes=0)
        scenes = 0
        for cycle, records in simulated:
            yield cycle, records
            scenes += len(records)
            bar.update(task, advance=1, scenes=scenes)


def _simulated(
    task: CycleTask, cycles: Sequence[int], workers: int, executor: Executor | None
) -> Iterator[tuple[int, list[SceneRecord]]]:
    try:
        with closing(run_all(task, cycles, executor, workers=workers)) as results:
            for index, records in results:
                yield cycles[index], records
    except WorkerDied as error:
        raise OSError(
            f"a worker process died (out of memory? {error.how}) {error.times} times at cycle {cycles[error.job]} "
            f"after {error.finished} of {len(cycles)} cycles; they are kept, start again to go on"
        ) from error
