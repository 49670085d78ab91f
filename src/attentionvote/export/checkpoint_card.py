"""The model card of a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attentionvote.contract import ModelCard, PartCard
from attentionvote.model.network import AttentionVote
from attentionvote.part import Parts

_MOST_HEAT = 1.0  # of a farthest vote
_PACKAGES = ("attentionvote", "torch", "onnx", "onnxscript", "onnxruntime", "numpy", "scipy")


def used_otherwise(
    model: AttentionVote, metadata: Mapping[str, Any], voting_radius: float | None, peak_threshold: float | None
) -> dict[str, Any]:
    """The metadata of a network that gathers votes or accepts peaks otherwise than its training's test did.

    The network's test radius is set. Figures of the training's test are left out when anything differs from what they
    were measured with; the confidence threshold stays the one that was chosen on the training's validation scenes.

    Args:
        model: the network.
        metadata: of its checkpoint.
        voting_radius: metres in which votes are gathered (Table 9); None keeps it.
        peak_threshold: heat a proposal needs (Fig. 11); None keeps it.

    Raises:
        ValueError: when no proposal could pass the threshold.
    """
    changed = dict(metadata)
    if peak_threshold is not None:
        if model.farthest is not None and peak_threshold > _MOST_HEAT:
            raise ValueError(
                f"peak_threshold must be at most {_MOST_HEAT:g}, the heat of all farthest-point proposals, got "
                f"{peak_threshold:g}"
            )
        changed["peak_threshold"] = float(peak_threshold)
    before = model.test_voting_radius or model.voting_radius
    if voting_radius is not None:
        model.test_voting_radius = float(voting_radius)
    if (model.test_voting_radius or before, changed["peak_threshold"]) != (before, metadata["peak_threshold"]):
        changed["test"] = {}
    return changed


def model_card(
    model: AttentionVote,
    metadata: Mapping[str, Any],
    part: Parts,
    distance: tuple[float, float],
    extent: float,
    run_id: str = "",
    commit: str = "",
) -> ModelCard:
    """What a cell must know of a trained network; figures of parity are added when they are measured.

    Args:
        model: the network.
        metadata: of its checkpoint, see ``training.checkpoint.load_trained``.
        part: its part, or set of parts.
        distance, extent: of the scenes it was trained for, metres.
        run_id: of the MLflow run.
        commit: of the code that trained it.

    Raises:
        ValueError: when the checkpoint is one of an unfinished training, whose working point is not chosen yet, or of
            other parts.
    """
    threshold = metadata["confidence_threshold"]
    if threshold is None:
        raise ValueError("the checkpoint must be of a finished training (model.ckpt), got one without a working point")
    stored, parts = metadata["part"], metadata.get("parts", ())
    if [member.digest for member in part.parts] != [member["digest"] for member in parts or [stored]]:
        raise ValueError(f"the checkpoint must be of {part.name} as it is now, got one of other parts: train it again")
    cards = tuple(_part_card(facts, member.box) for facts, member in zip(parts, part.parts, strict=False))
    radius = model.test_voting_radius
    return ModelCard(
        part=_part_card(stored, part.box),
        classes=tuple(card.name for card in cards) or (stored["name"],),
        points=int(metadata["points"]),
        votes=model.layout.seeds,
        proposals=min(model.proposals, model.layout.seeds),
        density=int(metadata["clouds"]["density"]),
        normal_neighbors=int(metadata["clouds"]["neighbors"]),
        peak_threshold=float(metadata["peak_threshold"]),
        confidence_threshold=float(threshold),
        distance=distance,
        extent=extent,
        data=dict(metadata["data"]),
        run_id=run_id,
        commit=commit,
        versions=package_versions(),
        evaluation={name: float(value) for name, value in metadata["test"].items()},
        parts=cards,
        voting_radius=None if radius is None or radius == model.voting_radius else float(radius),
    )


def _part_card(facts: Mapping[str, Any], box: NDArray[np.float64]) -> PartCard:
    """The card of what a checkpoint keeps of a part; a set has no symmetry of its own."""
    low, high = (tuple(map(float, corner)) for corner in box)
    return PartCard(
        name=facts["name"],
        title=facts["title"],
        diameter=float(facts["diameter"]),
        digest=facts["digest"],
        symmetry=_plain(facts.get("symmetry", {"kind": "none"})),
        box=(low, high),  # type: ignore[arg-type]  # three numbers each, which the card checks
    )


def package_versions() -> dict[str, str]:
    """Of the packages that decide what the graph is and what it answers."""
    return {name: version(name) for name in _PACKAGES}


def _plain(value: Any) -> Any:
    """The same of what JSON knows: a card read again equals the card that was written."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value
