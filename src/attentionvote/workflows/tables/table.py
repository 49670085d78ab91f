"""A table or figure of the paper: its objects and figures, the paper's numbers, and how ours are measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

VERBS = ("train", "export", "evaluate")
# And the section of conf/benchmark.yaml that says how each searches; the network's settings are those of its training.
DETECTORS = {"network": "", "ppf": "ppf", "ppf_icp": "ppf", "ppf_icp_fit": "ppf", "fpfh_icp": "fpfh"}
_KINDS = {"ap": "AP", "add_precision": "ADD precision", "add_recall": "ADD recall"}


@dataclass(frozen=True)
class Row:
    """A row of ours, or of what it is compared with.

    Args:
        name: shown; a row of the paper with this name belongs to it.
        detector: ``network``, ``ppf`` (point pair features), ``ppf_icp`` (with its registration), ``ppf_icp_fit``
            (and ranked by how well the pose fits) or ``fpfh_icp`` (fast point feature histograms, RANSAC and ICP).
        train, export, evaluate: further words of the verbs.
        together: set of parts that is measured in place of each object by itself: one network, all parts in one bin.
            The figures of its parts are the row's.
    """

    name: str
    detector: str = "network"
    train: tuple[str, ...] = ()
    export: tuple[str, ...] = ()
    evaluate: tuple[str, ...] = ()
    together: str | None = None

    def __post_init__(self) -> None:
        if "," in self.name:
            raise ValueError(f"a row's name must have no comma, rows= is a list of them; got {self.name!r}")
        if self.together is not None and self.detector != "network":
            raise ValueError(f"detector must be network for a row of parts together, got {self.detector!r}")
        if self.detector not in DETECTORS:
            raise ValueError(f"detector must be one of {', '.join(DETECTORS)}, got {self.detector!r}")


@dataclass(frozen=True)
class PaperRow:
    """Numbers of the paper: a method's values of one figure, one an object; None where the paper has none."""

    method: str
    figure: str
    values: tuple[float | None, ...]


@dataclass(frozen=True)
class Curve:
    """What a figure shows: the rows' ``figure`` as a curve, or where it is a number against the rows' names."""

    figure: str
    x: str
    y: str


@dataclass(frozen=True)
class BenchmarkTable:
    """A file of conf/table.

    Raises:
        ValueError: when its rows do not fit its objects and figures.
    """

    name: str
    title: str
    figures: tuple[str, ...]
    objects: tuple[str, ...]
    measured: tuple[Row, ...]
    paper: tuple[PaperRow, ...] = ()
    curve: Curve | None = None

    def __post_init__(self) -> None:
        for row in self.paper:
            if len(row.values) != len(self.objects) or row.figure not in self.figures:
                raise ValueError(
                    f"{self.name}: {row.method} must have {len(self.objects)} values of one of "
                    f"{', '.join(self.figures)}, got {len(row.values)} of {row.figure}"
                )
        names = [row.name for row in self.measured]
        if len(set(names)) != len(names):
            raise ValueError(f"{self.name}: every row must have a name of its own, got {', '.join(names)}")

    @classmethod
    def of(cls, name: str, content: Mapping[str, Any]) -> BenchmarkTable:
        """The table of a file's plain content."""
        rows = [Row(**{**row, **{verb: tuple(row.get(verb, ())) for verb in VERBS}}) for row in content["measured"]]
        paper = [PaperRow(row["method"], row["figure"], tuple(row["values"])) for row in content["paper"]]
        curve = Curve(**content["curve"]) if content["curve"] else None
        figures, objects = tuple(content["figures"]), tuple(content["objects"])
        return cls(name, content["title"], figures, objects, tuple(rows), tuple(paper), curve)

    def select(self, objects: str | None, rows: str | None) -> tuple[tuple[str, ...], tuple[Row, ...]]:
        """Objects and rows that are named, all by default.

        Raises:
            ValueError: when one is not the table's.
        """
        named = _list(objects) or list(self.objects)
        for name in named:
            if name not in self.objects:
                raise ValueError(f"objects must be among those of {self.name}, {', '.join(self.objects)}; got {name!r}")
        wanted = _list(rows)
        for name in wanted:
            if name not in [row.name for row in self.measured]:
                have = ", ".join(row.name for row in self.measured)
                raise ValueError(f"rows must be among those of {self.name}, {have}; got {name!r}")
        selected = [row for row in self.measured if not wanted or row.name in wanted]
        return tuple(named), tuple(selected)


def title_of(figure: str) -> str:
    """A figure's name for people: ``add_recall_10`` is "ADD recall at 10 % D"."""
    kind, _, threshold = figure.rpartition("_")
    return f"{_KINDS.get(kind, kind)} at {threshold} % D"


def mean(values: Sequence[float | None]) -> float | None:
    """The mean of all, None when one is missing."""
    present = [value for value in values if value is not None]
    return sum(present) / len(present) if len(present) == len(values) and present else None


def _list(words: str | None) -> list[str]:
    return [word.strip() for word in (words or "").split(",") if word.strip()]
