"""The ten objects of the paper's Table 1: how many scenes there must be, and what their readers have to know."""

from __future__ import annotations

import re
from dataclasses import dataclass

TRAIN_CYCLES, TEST_CYCLES = 500, 10


@dataclass(frozen=True)
class BenchmarkObject:
    """One line of Table 1.

    Args:
        name: stem of its file in ``conf/object``.
        diameter: D in metres.
        train_limit, test_limit: drop limits; of ring screw and gear shaft the test set is the real one.
        real: whether the paper's test set is a real one.
        sileane: cycles and scenes per cycle of the Sileane dataset, or None.
        farthest: metres; in Sileane's pictures the bin's floor lies beyond it.
        nearest: metres; in IPA's real pictures what is nearer is no part.
    """

    name: str
    diameter: float
    train_limit: int
    test_limit: int
    real: bool = False
    sileane: tuple[int, int] | None = None
    farthest: float | None = None
    nearest: float | None = None

    def expected_ipa_scenes(self, split: str) -> int | None:
        """Scenes with at least five drops that Table 1 has for a split of the IPA dataset; None: it has none.

        One for each number of drops from 5 to the limit: 500 (limit - 4) for training, 10 (limit - 4) for tests.
        """
        if split == "train":
            return TRAIN_CYCLES * (self.train_limit - 4)
        if split == ("real" if self.real else "test"):
            return TEST_CYCLES * (self.test_limit - 4)
        return None


BENCHMARK_OBJECTS = (
    BenchmarkObject("bunny", 0.234, 80, 80, sileane=(4, 81), farthest=1.51),
    BenchmarkObject("candlestick", 0.191, 60, 60, sileane=(2, 61), farthest=1.01),
    BenchmarkObject("pepper", 0.335, 90, 90, sileane=(2, 91), farthest=1.51),
    BenchmarkObject("brick", 0.037, 150, 150, sileane=(2, 151), farthest=1.01),
    BenchmarkObject("gear", 0.121, 60, 60, sileane=(2, 61), farthest=2.01),
    BenchmarkObject("tless_20", 0.107, 99, 99, sileane=(2, 100), farthest=1.01),
    BenchmarkObject("tless_22", 0.108, 100, 100, sileane=(2, 101), farthest=1.01),
    BenchmarkObject("tless_29", 0.135, 79, 79, sileane=(2, 80), farthest=1.01),
    BenchmarkObject("ring_screw", 0.155, 35, 28, real=True, nearest=1.26),
    BenchmarkObject("gear_shaft", 0.437, 30, 22, real=True),
)
_BY_KEY = {o.name.replace("_", ""): o for o in BENCHMARK_OBJECTS}


def benchmark_object(name: str) -> BenchmarkObject | None:
    """The object a folder's or file's name means (``SileaneBunny``, ``IPARingScrew``, ``tless_20``), or None."""
    key = re.sub(r"[^a-z0-9]", "", re.sub(r"_part_\d+$", "", name).lower())
    key = re.sub(r"^(sileane|ipa)", "", key)
    return _BY_KEY.get({"cstick": "candlestick"}.get(key, key))
