"""The gates of a promotion: what must hold before a model may move into the cells, judged one by one.

Plain numbers in, sentences out: nothing here measures, reads or writes. A gate that cannot be judged does not hold.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any

from attentionvote.contract import ModelCard
from attentionvote.export.parity_record import Limits, Parity
from attentionvote.section import check
from attentionvote.setting import Setting

if TYPE_CHECKING:
    from attentionvote.evaluation.intervals import LeftOut

PROVENANCE = ("commit", "data", "config", "versions", "signature")


@dataclass(frozen=True)
class Rules:
    """What a promotion demands; figures whose value is null are left out.

    Raises:
        SettingError: when a value is out of its range.
    """

    scenes: Annotated[int, Setting("Least size of the evaluation set.", low=0, high=1_000_000)]
    floors: Annotated[
        Mapping[str, float | None], Setting("Least values by figure, whatever the champion reaches.", low=0, high=1)
    ]
    margins: Annotated[
        Mapping[str, float | None],
        Setting(
            "How much less than the champion's a figure may be: a larger loss must be excluded by the lower end of the "
            "95 % interval of the paired difference.",
            low=0,
            high=1,
        ),
    ]
    latency_p95_ms: Annotated[
        float, Setting("Largest 95th percentile of an estimate on the machine that promotes.", above=0, high=600_000)
    ]
    parity: Limits
    provenance: Annotated[tuple[str, ...], Setting("What must be known of the model's origin.", choices=PROVENANCE)] = (
        PROVENANCE
    )

    def __post_init__(self) -> None:
        check(self)

    def demanded(self, name: str) -> dict[str, float]:
        """``floors`` or ``margins`` without the figures whose value is null."""
        return {figure: value for figure, value in getattr(self, name).items() if value is not None}


@dataclass(frozen=True)
class Gate:
    """One gate: its name, whether it holds, what it demands and what was found."""

    name: str
    holds: bool
    demands: str
    finding: str

    def __str__(self) -> str:
        return f"{'holds' if self.holds else 'FAILS'}: {self.demands}; {self.finding}"


@dataclass(frozen=True)
class Evidence:
    """What is known of one model.

    Attributes:
        figures: of ``Measurement.figures``.
        left_out: of ``Measurement.left_out``; of two models on the same scenes; none of a set of one drop cycle.
    """

    figures: Mapping[str, float]
    left_out: Mapping[str, LeftOut] = field(repr=False)


@dataclass(frozen=True)
class Origin:
    """What the tracking store knows of the training that made a model.

    Attributes:
        has_run: whether it has the run that the card names.
        has_config: whether the run holds its resolved configuration.
        commits: what the run was made with, session by session, as a card names it.
        has_changes: whether it holds, whole, the changes of every session whose commit was not clean.
        signed_by: fingerprint of the key whose signature was verified.
    """

    has_run: bool
    has_config: bool = False
    commits: tuple[str, ...] = ()
    has_changes: bool = False
    signed_by: str = ""


def judge(
    rules: Rules, candidate: Evidence, champion: Evidence | None, card: ModelCard, origin: Origin, scenes: int
) -> list[Gate]:
    """Every gate, in the order in which people ask.

    Args:
        rules: what is demanded.
        candidate: measured on the evaluation set.
        champion: measured on the same scenes in the same process; None when there is none yet.
        card: of the candidate.
        origin: of the candidate.
        scenes: in the evaluation set.
    """
    gates = [Gate("scenes", scenes >= rules.scenes, f"at least {rules.scenes} scenes", f"measured on {scenes}")]
    gates += _floors(rules.demanded("floors"), candidate)
    if champion is not None:
        gates += _not_worse(rules.demanded("margins"), candidate, champion)
    gates += [_latency(rules.latency_p95_ms, candidate), _parity(card, rules.parity)]
    return gates + [gate for gate in _provenance(card, origin) if gate.name in rules.provenance]


def _floors(floors: Mapping[str, float], candidate: Evidence) -> Iterator[Gate]:
    for name, floor in floors.items():
        value = candidate.figures.get(name)
        demands = f"{name} at least {floor:g}"
        if value is None:
            yield Gate(f"floor {name}", False, demands, "it was not measured")
            continue
        finding = f"{value:.4f}"
        if name in candidate.left_out:
            sure = candidate.left_out[name].interval()
            finding += f" ({sure.low:.3f} to {sure.high:.3f})"
        yield Gate(f"floor {name}", value >= floor, demands, finding)


def _not_worse(margins: Mapping[str, float], candidate: Evidence, champion: Evidence) -> Iterator[Gate]:
    for name, margin in margins.items():
        demands = f"{name} at most {margin:g} below the champion's"
        if name not in candidate.figures or name not in champion.figures:
            yield Gate(f"champion {name}", False, demands, "it was not measured for both")
            continue
        if name not in candidate.left_out or name not in champion.left_out:
            yield Gate(f"champion {name}", False, demands, "of one drop cycle no interval is known: measure on more")
            continue
        sure = candidate.left_out[name].minus(champion.left_out[name])
        finding = f"{champion.figures[name]:.4f} {sure.value:+.4f} ({sure.low:+.4f} to {sure.high:+.4f})"
        yield Gate(f"champion {name}", sure.low >= -margin, demands, finding)


def _latency(budget_ms: float, candidate: Evidence) -> Gate:
    p50, p95 = (candidate.figures[f"latency_{name}_ms"] for name in ("p50", "p95"))
    return Gate("latency", p95 <= budget_ms, f"p95 at most {budget_ms:g} ms", f"{p95:.0f} ms (p50 {p50:.0f})")


def _parity(card: ModelCard, limits: Limits) -> Gate:
    demands = "a proof of parity within the limits"
    paths: Any = card.parity.get("paths")
    if not isinstance(paths, Mapping) or not paths:
        return Gate("parity", False, demands, "the card holds no proof: export the model again")
    finding = []
    for path, content in paths.items():
        try:
            parity = Parity.from_dict(content)
        except ValueError as error:
            return Gate("parity", False, demands, f"{path}: {error}")
        broken = parity.violations(limits)
        if broken:
            return Gate("parity", False, demands, f"{path}: {broken[0]}")
        finding.append(f"{path} {parity.translation_mm:.4f} mm, {parity.rotation_degrees:.4f} degrees")
    return Gate("parity", True, demands, "; ".join(finding))


def _provenance(card: ModelCard, origin: Origin) -> Iterator[Gate]:
    yield _commit(card.commit, origin)
    missing = [split for split in ("train", "val", "test") if not card.data.get(split)]
    digests = ", ".join(f"{split} {digest[:8]}" for split, digest in card.data.items())
    yield Gate("data", not missing, "digests of all scene sets", digests if not missing else f"no {missing[0]} digest")
    where = f"run {card.run_id[:8]}" if card.run_id else "the card names no run"
    has_config = origin.has_run and origin.has_config
    problem = "" if has_config else (" has no config.yaml" if origin.has_run else " is not in the store")
    yield Gate("config", has_config, "the run's resolved configuration", where + problem * bool(card.run_id))
    lacking = [name for name in ("attentionvote", "torch", "onnx", "onnxruntime") if name not in card.versions]
    versions = ", ".join(f"{name} {card.versions[name]}" for name in ("torch", "onnxruntime") if name in card.versions)
    yield Gate("versions", not lacking, "versions of what made it", f"no {lacking[0]}" if lacking else versions)
    signed = f"key {origin.signed_by}" if origin.signed_by else "no signature was verified"
    yield Gate("signature", bool(origin.signed_by), "the signature of the trusted key", signed)


def _commit(card_commit: str, origin: Origin) -> Gate:
    demands = "the commit that its run names, clean or with its changes recorded"
    well_formed = [len(name) == 40 and set(name) <= set("0123456789abcdef") for name, _ in map(_split, origin.commits)]
    if not origin.commits or not all(well_formed):
        return Gate("commit", False, demands, f"the card says {card_commit or 'none'}, the run names none")
    if card_commit != origin.commits[-1]:
        return Gate("commit", False, demands, f"the card says {card_commit or 'none'}, the run {origin.commits[-1]}")
    dirty = any(changes for _, changes in map(_split, origin.commits))
    finding = " then ".join(dict.fromkeys(_split(commit)[0][:12] for commit in origin.commits))
    if dirty:
        finding += f" with changes that are {'recorded' if origin.has_changes else 'not recorded whole'}"
    return Gate("commit", not dirty or origin.has_changes, demands, finding)


def _split(commit: str) -> tuple[str, bool]:
    """The hash, and whether the work tree differed from it."""
    name, _, changes = commit.partition("+")
    return name, bool(changes)
