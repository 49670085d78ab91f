"""The one agreement between training and cell: the exported graph's tensors and the card that travels with it.

The training side writes both, the cell reads both, and neither imports the other. The card is complete: an estimator
needs nothing else to know units, frame, thresholds and preprocessing. Its figures of parity and evaluation are
measured *on* the graph, so the graph itself carries the card without them (:meth:`ModelCard.core`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, NamedTuple

VERSION = 1
UNITS = "m"
FRAME = "camera: x right, y down, z forward (OpenCV)"
CARD_KEY = "attentionvote"  # of the card in the graph's metadata_props
INPUTS = ("points", "normals")


class TensorSpec(NamedTuple):
    """Name and shape of one tensor of the graph; all are float32."""

    name: str
    shape: tuple[int, ...]


@dataclass(frozen=True)
class PartCard:
    """What the model looks for.

    Attributes:
        name, title: of the part's configuration.
        diameter: D in metres.
        digest: sha256 of surface, diameter and symmetry.
        symmetry: arguments of ``geometry.symmetry.Symmetry``.
        box: lowest and highest corner in the part's own frame, metres.
    """

    name: str
    title: str
    diameter: float
    digest: str
    symmetry: Mapping[str, Any]
    box: tuple[tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True)
class ModelCard:
    """Everything a cell must know about a model.

    Attributes:
        part: what it looks for.
        classes: names of the classes, NC of them.
        points: N, points of the graph's input.
        votes, proposals: M and K of its outputs.
        density: normals are estimated on at most this many points of the cloud.
        normal_neighbors: neighbours of that estimation.
        peak_threshold, confidence_threshold: a proposal below either is no detection.
        distance: nearest and farthest depth (metres) of the clouds the model was trained for.
        extent: largest side of the axis-parallel box around such a cloud, metres.
        data: digests of the scene sets by split.
        run_id: of the MLflow run; empty when there was none.
        commit: of the code that trained it; ends with ``+dirty`` when there were uncommitted changes.
        versions: of the packages that made the graph.
        parity: figures of the proof of equality with the checkpoint.
        evaluation: figures of the test.
    """

    part: PartCard
    classes: tuple[str, ...]
    points: int
    votes: int
    proposals: int
    density: int
    normal_neighbors: int
    peak_threshold: float
    confidence_threshold: float
    distance: tuple[float, float]
    extent: float
    data: Mapping[str, str] = field(default_factory=dict)
    run_id: str = ""
    commit: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    parity: Mapping[str, Any] = field(default_factory=dict)
    evaluation: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("points", "votes", "proposals", "density", "normal_neighbors"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"card {name} must be a whole number of at least 1, got {value!r}")
        numbers = {"part.diameter": self.part.diameter, "extent": self.extent, "distance": self.distance[0]}
        for name, number in numbers.items():
            if not (math.isfinite(number) and number > 0):
                raise ValueError(f"card {name} must be positive metres, got {number}")
        if not self.distance[0] < self.distance[1]:
            raise ValueError(f"card distance must be a rising range, got {list(self.distance)}")
        for name in ("peak_threshold", "confidence_threshold"):
            number = getattr(self, name)
            if not (math.isfinite(number) and number >= 0):
                raise ValueError(f"card {name} must be a number of at least 0, got {number}")
        if not self.classes:
            raise ValueError("card classes must name at least one class, got none")

    @property
    def inputs(self) -> tuple[TensorSpec, ...]:
        """The graph's inputs, batch 1."""
        return tuple(TensorSpec(name, (1, self.points, 3)) for name in INPUTS)

    @property
    def outputs(self) -> tuple[TensorSpec, ...]:
        """The graph's outputs: the fields of the network's ``Predictions``, in order."""
        m, k = self.votes, self.proposals
        return (
            TensorSpec("vote_xyz", (1, m, 3)),
            TensorSpec("center_seed", (1, k, 3)),
            TensorSpec("peak_heat", (1, k)),
            TensorSpec("center", (1, k, 3)),
            TensorSpec("quaternion", (1, k, 4)),
            TensorSpec("class_logits", (1, k, len(self.classes))),
            TensorSpec("confidence", (1, k)),
        )

    def core(self) -> ModelCard:
        """The card without what is measured on the graph: what the graph carries in itself."""
        return replace(self, parity={}, evaluation={})

    def to_json(self) -> str:
        """Canonical JSON: the same card, the same text."""
        content = {"contract_version": VERSION, "units": UNITS, "frame": FRAME, **asdict(self)}
        return json.dumps(content, sort_keys=True, indent=1, ensure_ascii=False, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> ModelCard:
        """A card from its JSON.

        Raises:
            ValueError: with one sentence, when the text is no card of this contract.
        """
        try:
            content = json.loads(text)
        except ValueError as error:
            raise ValueError(f"a model card must be JSON, got a text that is none ({error})") from error
        if not isinstance(content, dict):
            raise ValueError(f"a model card must be a JSON object, got {type(content).__name__}")
        for name, expected in (("contract_version", VERSION), ("units", UNITS), ("frame", FRAME)):
            if content.pop(name, None) != expected:
                raise ValueError(
                    f"a model card must have {name} {expected!r}, got {json.loads(text).get(name)!r}: "
                    "export the model again with this version"
                )
        part = _plain("card part", PartCard, content.get("part"))
        part["box"] = _tuples(part["box"])
        content = _plain("card", cls, content)
        content |= {
            "part": PartCard(**part),
            "classes": tuple(content["classes"]),
            "distance": tuple(map(float, content["distance"])),
        }
        try:
            return cls(**content)
        except TypeError as error:
            raise ValueError(f"a model card must have fields of the right type: {error}") from error


def _plain(what: str, kind: type, content: object) -> dict[str, Any]:
    """The fields of a dataclass from a JSON object, neither more nor fewer."""
    names = [f.name for f in fields(kind)]
    if not isinstance(content, dict) or set(content) != set(names):
        got = sorted(content) if isinstance(content, dict) else type(content).__name__
        raise ValueError(f"{what} must have the fields {', '.join(names)}; got {got}")
    return dict(content)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
