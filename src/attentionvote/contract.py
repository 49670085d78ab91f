"""The one agreement between training and cell: the exported graph's tensors and the card that travels with it.

The training side writes both, the cell reads both, and neither imports the other. The card is complete: an estimator
needs nothing else to know units, frame, thresholds and preprocessing. Its figures of parity are measured on the
finished graph, so the graph itself carries the card without figures (:meth:`ModelCard.core`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

VERSION = 1
UNITS = "m"
FRAME = "camera: x right, y down, z forward (OpenCV)"
CARD_KEY = "attentionvote"  # of the card in the graph's metadata_props
# Came later: absent where it is None, so that older cells read such cards and newer ones read old cards.
_OPTIONAL = ("voting_radius", "parts")
INPUTS = ("points", "normals")
# What the graph finds itself where it is not given: which points are centres, and each level's neighbours. Their sizes
# are a JSON object in metadata_props; a graph without it can be given nothing.
FOUND = ("order", "neighbors_1", "neighbors_2", "neighbors_3", "neighbors_4")
LAYOUT_KEY = "attentionvote.layout"


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

    Raises:
        ValueError: with one sentence, on values that no part has.
    """

    name: str
    title: str
    diameter: float
    digest: str
    symmetry: Mapping[str, Any]
    box: tuple[tuple[float, float, float], tuple[float, float, float]]

    def __post_init__(self) -> None:
        for name in ("name", "title", "digest"):
            _check_text(f"part.{name}", getattr(self, name))
        if not self.name:
            raise ValueError("card part.name must not be empty")
        if not isinstance(self.symmetry, Mapping):
            raise ValueError(f"card part.symmetry must be the arguments of a symmetry, got {self.symmetry!r}")
        object.__setattr__(self, "diameter", _length("part.diameter", self.diameter))
        try:
            low, high = (tuple(float(x) for x in corner) for corner in self.box)
        except (TypeError, ValueError) as error:
            raise ValueError(f"card part.box must be two corners of three numbers, got {self.box!r}") from error
        if not len(low) == len(high) == 3 or not all(
            a < b and b - a < math.inf for a, b in zip(low, high, strict=True)
        ):
            raise ValueError(f"card part.box must be a lowest and a highest corner in metres, got {[low, high]}")
        object.__setattr__(self, "box", (low, high))


@dataclass(frozen=True)
class ModelCard:
    """Everything a cell must know about a model.

    Attributes:
        part: what it looks for; of a set of parts its name, digest, the largest diameter and a box that holds them all.
        classes: names of the classes, NC of them.
        points: N, points of the graph's input.
        votes, proposals: M and K of its outputs.
        density: normals are estimated on at most this many points of the cloud.
        normal_neighbors: neighbours of that estimation.
        peak_threshold, confidence_threshold: a proposal below either is no detection.
        voting_radius: metres in which the graph gathers votes where that is not the training's; None where it is.
        distance: nearest and farthest depth (metres) of the clouds the model was trained for.
        extent: largest side of the axis-parallel box around such a cloud, metres.
        data: digests of the scenes by split; of a dataset's also ``cycles``, the first eight digits of the digest of
            every drop cycle that was learned from, and ``scene_set`` where the dataset was written from one.
        run_id: of the MLflow run; empty when there was none.
        commit: of the code that trained it; ends with ``+dirty`` when there were uncommitted changes.
        versions: of the packages that made the graph.
        parity: figures of the proof of equality with the checkpoint.
        evaluation: figures of the test.
        parts: every part of a set, in the order of the classes; empty where there is one.

    Raises:
        ValueError: with one sentence, on values that no model has.
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
    voting_radius: float | None = None
    parts: tuple[PartCard, ...] = ()

    def __post_init__(self) -> None:
        for name in ("points", "votes", "proposals", "density", "normal_neighbors"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"card {name} must be a whole number of at least 1, got {value!r}")
        object.__setattr__(self, "extent", _length("extent", self.extent))
        if self.voting_radius is not None:
            object.__setattr__(self, "voting_radius", _length("voting_radius", self.voting_radius))
        if not isinstance(self.distance, (tuple, list)) or len(self.distance) != 2:
            raise ValueError(f"card distance must be two lengths, nearest and farthest, got {self.distance!r}")
        near, far = (_length("distance", value) for value in self.distance)
        if not near < far:
            raise ValueError(f"card distance must be a rising range, got {[near, far]}")
        object.__setattr__(self, "distance", (near, far))
        for name in ("peak_threshold", "confidence_threshold"):
            number = _number(name, getattr(self, name))
            if not number >= 0:
                raise ValueError(f"card {name} must be a number of at least 0, got {number}")
            object.__setattr__(self, name, number)
        if not isinstance(self.classes, (tuple, list)) or not self.classes:
            raise ValueError(f"card classes must name at least one class, got {self.classes!r}")
        for name in self.classes:
            _check_text("classes", name)
        object.__setattr__(self, "classes", tuple(self.classes))
        object.__setattr__(self, "parts", tuple(self.parts))
        if self.parts and (len(self.parts) < 2 or tuple(part.name for part in self.parts) != self.classes):
            names = ", ".join(part.name for part in self.parts)
            raise ValueError(f"card parts must be the classes {', '.join(self.classes)}, two or more, got {names}")
        for name in ("run_id", "commit"):
            _check_text(name, getattr(self, name))
        for name in ("data", "versions", "parity", "evaluation"):
            if not isinstance(getattr(self, name), Mapping):
                raise ValueError(f"card {name} must be values by name, got {getattr(self, name)!r}")

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

    @property
    def each_part(self) -> tuple[PartCard, ...]:
        """The part of every class."""
        return self.parts or (self.part,)

    def core(self) -> ModelCard:
        """The card without what is measured on the graph: what the graph carries in itself."""
        return replace(self, parity={}, evaluation={})

    def to_json(self) -> str:
        """Canonical JSON: the same card, the same text."""
        content = {"contract_version": VERSION, "units": UNITS, "frame": FRAME, **asdict(self)}
        for name in _OPTIONAL:
            if content[name] in (None, ()):
                del content[name]
        return json.dumps(content, sort_keys=True, indent=1, ensure_ascii=False, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> ModelCard:
        """A card from its JSON.

        Raises:
            ValueError: with one sentence, when the text is no card of this contract.
        """
        try:
            content = json.loads(text, parse_constant=_no_number)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"a model card must be JSON, got a text that is none ({error})") from error
        if not isinstance(content, dict):
            raise ValueError(f"a model card must be a JSON object, got {type(content).__name__}")
        for name, expected in (("contract_version", VERSION), ("units", UNITS), ("frame", FRAME)):
            said = content.pop(name, None)
            if said != expected or type(said) is not type(expected):
                raise ValueError(
                    f"a model card must have {name} {expected!r}, got {said!r}: "
                    "export the model again with this version"
                )
        content = _plain("card", cls, content)
        content["part"] = PartCard(**_plain("card part", PartCard, content["part"]))
        if "parts" in content:
            if not isinstance(content["parts"], list):
                raise ValueError(f"card parts must be a list of parts, got {content['parts']!r}")
            content["parts"] = tuple(PartCard(**_plain("card parts", PartCard, part)) for part in content["parts"])
        return cls(**content)


def is_detection(
    heat: NDArray[np.floating], confidence: NDArray[np.floating], peak_threshold: float, confidence_threshold: float
) -> NDArray[np.bool_]:
    """Which proposals count as detections, in training's figures and in the cell alike.

    Args:
        heat, confidence: of the proposals, any shape.
        peak_threshold, confidence_threshold: least values; 0 is never enough: it marks a place without a peak, and a
            proposal that was merged into another.
    """
    return (heat >= peak_threshold) & (heat > 0) & (confidence >= confidence_threshold) & (confidence > 0)


def _plain(what: str, kind: type, content: object) -> dict[str, Any]:
    """The fields of a dataclass from a JSON object, neither more nor fewer but for the optional ones."""
    names = [f.name for f in fields(kind)]
    if not isinstance(content, dict) or not set(names) - set(_OPTIONAL) <= set(content) <= set(names):
        got = sorted(content) if isinstance(content, dict) else type(content).__name__
        raise ValueError(f"{what} must have the fields {', '.join(names)}; got {got}")
    return dict(content)


def _check_text(name: str, value: object) -> None:
    if not isinstance(value, str):
        raise ValueError(f"card {name} must be a text, got {value!r}")


def _number(name: str, value: object) -> float:
    """A finite number, also numpy's."""
    try:
        number = math.nan if isinstance(value, (str, bytes, bool)) else float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"card {name} must be a finite number, got {value!r}")
    return number


def _length(name: str, value: object) -> float:
    number = _number(name, value)
    if not number > 0:
        raise ValueError(f"card {name} must be positive metres, got {number}")
    return number


def _no_number(word: str) -> None:
    raise ValueError(f"{word} is no JSON")
