"""Record of a proof of equality: its measurements, their limits, and their stored and printed forms."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Annotated, Any

from attentionvote.section import check
from attentionvote.setting import Setting

NAMES = ("ap_10", "ap_5", "ap_2")
_COUNTS = ("scenes", "pairs", "unmatched", "worst_scene")


@dataclass(frozen=True)
class Limits:
    """What graph and checkpoint may differ at most.

    Raises:
        SettingError: when a limit is out of its range.
    """

    translation_mm: Annotated[float, Setting("Largest difference of a matched pair.", low=0, high=1000)]
    translation_p99_mm: Annotated[float, Setting("99th percentile of all matched pairs.", low=0, high=1000)]
    rotation_degrees: Annotated[float, Setting("Largest difference of a matched pair.", low=0, high=180)]
    rotation_p99_degrees: Annotated[float, Setting("99th percentile of all matched pairs.", low=0, high=180)]
    confidence: Annotated[float, Setting("Largest difference of a matched pair.", low=0, high=1)]
    confidence_p99: Annotated[float, Setting("99th percentile of all matched pairs.", low=0, high=1)]
    unmatched: Annotated[int, Setting("Detections without a partner, both sides together.", low=0, high=1_000_000)]
    ap: Annotated[float, Setting("Average precision at 10, 5 and 2 % of D.", low=0, high=1)]
    scenes: Annotated[int, Setting("Least number of scenes for a proof.", low=0, high=100_000)]

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class Parity:
    """Measured differences between checkpoint and graph; ``ap`` holds both sides' figures by name.

    ``rotation`` is the least angle over the part's symmetries. ``pairs`` are matched detections. ``worst_scene`` holds
    the largest translation, ``unmatched_scenes`` those with a detection that only one side has: indices of the scenes
    compared.
    """

    scenes: int
    pairs: int
    unmatched: int
    translation_mm: float
    translation_p99_mm: float
    rotation_degrees: float
    rotation_p99_degrees: float
    confidence: float
    confidence_p99: float
    ap: Mapping[str, tuple[float, float]]
    worst_scene: int = 0
    unmatched_scenes: tuple[int, ...] = ()

    def violations(self, limits: Limits) -> list[str]:
        """One sentence for every limit that is broken; none when graph and checkpoint are equal."""
        broken = []
        if self.scenes < limits.scenes:
            broken.append(f"scenes must be at least {limits.scenes}, got {self.scenes}")
        if not self.pairs:
            broken.append("at least one detection must be compared, got none: the model finds nothing in these scenes")
        for name in (entry.name for entry in fields(Limits) if entry.name not in ("ap", "scenes")):
            value, limit = getattr(self, name), getattr(limits, name)
            if not value <= limit:
                scenes = self.unmatched_scenes if name == "unmatched" else (self.worst_scene,)
                where = f" (scene {', '.join(map(str, scenes[:5]))})" if "p99" not in name else ""
                broken.append(f"{name} must be at most {limit:g}, got {value:.4g}{where}")
        for name, (ours, theirs) in self.ap.items():
            if not abs(ours - theirs) <= limits.ap:
                broken.append(f"{name} must agree within {limits.ap:g}, got {ours:.4f} and {theirs:.4f}")
        return broken

    def as_dict(self) -> dict[str, object]:
        """Plain values for the card and the report."""
        ap = {name: [float(a), float(b)] for name, (a, b) in self.ap.items()}
        return asdict(self) | {"ap": ap, "unmatched_scenes": list(self.unmatched_scenes)}

    @classmethod
    def from_dict(cls, content: object) -> Parity:
        """The record that :meth:`as_dict` made, as a model's card keeps it.

        Raises:
            ValueError: when it is no such record.
        """
        names = {field.name for field in fields(cls)}
        if not isinstance(content, dict) or set(content) != names or not isinstance(content["ap"], dict):
            raise ValueError(f"a record of parity must have the fields {', '.join(sorted(names))}, got another one")
        values: dict[str, Any] = dict(content)
        try:
            values["ap"] = {str(name): (float(a), float(b)) for name, (a, b) in values["ap"].items()}
            values["unmatched_scenes"] = tuple(int(i) for i in values["unmatched_scenes"])
            for name in names - {"ap", "unmatched_scenes"}:
                values[name] = (int if name in _COUNTS else float)(values[name])
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"a record of parity must hold numbers, got something else ({error})") from error
        return cls(**values)


def table(parity: Mapping[str, Parity], limits: Limits) -> Iterator[str]:
    """Lines for the terminal: a column for every execution path."""
    names = list(parity)
    rows: list[tuple[str, list[str], str]] = [
        ("scenes", [f"{p.scenes}" for p in parity.values()], f">= {limits.scenes}"),
        ("matched poses", [f"{p.pairs}" for p in parity.values()], ">= 1"),
        ("unmatched poses", [f"{p.unmatched}" for p in parity.values()], f"{limits.unmatched}"),
        ("translation, max (mm)", [f"{p.translation_mm:.4f}" for p in parity.values()], f"{limits.translation_mm:g}"),
        ("translation, p99 (mm)", [f"{p.translation_p99_mm:.4f}" for p in parity.values()],
         f"{limits.translation_p99_mm:g}"),
        ("rotation, max (degrees)", [f"{p.rotation_degrees:.4f}" for p in parity.values()],
         f"{limits.rotation_degrees:g}"),
        ("rotation, p99 (degrees)", [f"{p.rotation_p99_degrees:.4f}" for p in parity.values()],
         f"{limits.rotation_p99_degrees:g}"),
        ("confidence, max", [f"{p.confidence:.5f}" for p in parity.values()], f"{limits.confidence:g}"),
        ("confidence, p99", [f"{p.confidence_p99:.5f}" for p in parity.values()], f"{limits.confidence_p99:g}"),
    ]  # fmt: skip
    for name in NAMES:
        cells = ["{:.4f} | {:.4f}".format(*p.ap[name]) for p in parity.values()]
        rows.append((f"AP at {name[3:]} % D, torch | graph", cells, f"+-{limits.ap:g}"))
    yield f"{'':32s}" + "".join(f"{name:>22s}" for name in names) + f"{'limit':>12s}"
    for title, cells, limit in rows:
        yield f"{title:32s}" + "".join(f"{cell:>22s}" for cell in cells) + f"{limit:>12s}"
