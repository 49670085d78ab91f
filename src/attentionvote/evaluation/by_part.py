"""Figures of a bin with several parts: every part by itself, and their mean (Table 6 of the paper).

A result belongs to the part that the detector calls it. Under the name of another part it is a stray of that part, and
what it lies on is missed: naming is part of finding.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

from attentionvote.evaluation.scene_result import Array, SceneResult
from attentionvote.part import Part, Parts

Value = TypeVar("Value", float, Array)
COUNTS = ("duplicates_", "strays_", "misses_")  # numbers, not shares: their sum is said, not their mean


def by_part(
    scenes: Sequence[SceneResult],
    parts: Parts,
    figures_of: Callable[[list[SceneResult], Part], Mapping[str, Value]],
) -> dict[str, Value]:
    """Figures of every part, ``NAME/figure``, and of the set, ``figure``: the mean over its parts, counts their sum.

    A part on which a figure cannot be measured (no true positive, say) is left out of the mean. Parts weigh the same,
    however many instances of them there are, as in the paper.

    Args:
        scenes: results and truth of all parts, with their ``part_ids``.
        parts: the set, in the order of the ids.
        figures_of: flat figures of one part from the scenes with its results and truth alone.
    """
    part_figures = {part.name: figures_of([s.of_part(k) for s in scenes], part) for k, part in enumerate(parts.parts)}
    together: dict[str, Value] = {}
    for name in dict.fromkeys(name for figures in part_figures.values() for name in figures):
        values = [figures[name] for figures in part_figures.values() if name in figures]
        total = sum(values[1:], start=values[0])
        together[name] = total if name.startswith(COUNTS) else total / len(values)
    return together | {
        f"{part}/{name}": value for part, figures in part_figures.items() for name, value in figures.items()
    }
