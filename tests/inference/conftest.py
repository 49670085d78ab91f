"""Real bundles without a training stack: tiny ONNX graphs that honour the contract, real keys, real signatures.

The tiny graph answers four proposals at fixed offsets from the centroid of the points. ``make_bundle`` writes a
bundle of it and takes what a test wants different; ``make_cloud`` gives a cloud the tiny model knows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pytest
from hypothesis import strategies as st
from numpy.typing import NDArray

from attentionvote.contract import CARD_KEY, ModelCard, PartCard
from attentionvote.inference.answer import Estimate
from attentionvote.inference.bundle import Bundle, write_manifest
from attentionvote.inference.estimator import PoseEstimator
from attentionvote.inference.signature import load_private_key, make_keys

OFFSETS = ((0.0, 0.0, 0.0), (0.05, 0.0, 0.0), (-0.05, 0.0, 0.0), (0.0, 0.05, 0.0))
HALF = 0.5**0.5
QUATERNIONS = ((1.0, 0.0, 0.0, 0.0), (HALF, 0.0, 0.0, HALF), (0.5, 0.5, 0.5, 0.5), (0.0, 1.0, 0.0, 0.0))
HEAT = (9.0, 6.0, 3.0, 0.0)  # the last one is no peak
CONFIDENCE = (0.7, 0.95, 0.3, 0.99)  # the third is below the threshold, the second is the best
PLY = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
PLY += b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n0.1 0 0\n0 0.1 0\n3 0 1 2\n"


def tiny_card(**changes: Any) -> ModelCard:
    """The card of the tiny graph; ``part`` takes changes of the part's card."""
    part = {
        "name": "bracket",
        "title": "a bracket",
        "diameter": 0.1,
        "digest": "0" * 64,
        "symmetry": {"kind": "none"},
        "box": ((-0.05, -0.02, -0.01), (0.05, 0.02, 0.01)),
    } | changes.pop("part", {})
    fields: dict[str, Any] = {
        "part": PartCard(**part),
        "classes": ("bracket",),
        "points": 256,
        "votes": 64,
        "proposals": 4,
        "density": 2000,
        "normal_neighbors": 30,
        "peak_threshold": 0.4,
        "confidence_threshold": 0.5,
        "distance": (0.6, 1.0),
        "extent": 0.43,
        "parity": {"translation_mm": 0.01},
        "evaluation": {"ap": 0.9},
    }
    return ModelCard(**fields | changes)


def tiny_graph(
    card: ModelCard,
    *,
    heat: Sequence[float] = HEAT,
    confidence: Sequence[float] = CONFIDENCE,
    quaternions: Sequence[Sequence[float]] = QUATERNIONS,
    offsets: Sequence[Sequence[float]] = OFFSETS,
    loops: int = 0,
    metadata: bool = True,
) -> Any:
    """An ``onnx.ModelProto``: proposals at ``offsets`` from the points' centroid, the rest constant.

    Args:
        card: sizes of the tensors, and what the graph carries.
        heat, confidence, quaternions, offsets: of the proposals.
        loops: iterations of a loop of small products before the answer, about 2 microseconds each.
        metadata: whether the graph carries its card.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    k = card.proposals
    constants = {
        "axis": np.array([1], np.int64),
        "start": np.array([0], np.int64),
        "end": np.array([card.votes], np.int64),
        "step": np.float32(0.01),
        "offsets": np.array(offsets, np.float32).reshape(1, k, 3),
        "no_seed": np.zeros((1, k, 3), np.float32),
        "heat": np.array(heat, np.float32).reshape(1, k),
        "quaternions": np.array(quaternions, np.float32).reshape(1, k, 4),
        "logits": np.zeros((1, k, len(card.classes)), np.float32),
        "score": np.array(confidence, np.float32).reshape(1, k),
        "trips": np.array(loops, np.int64),
        "always": np.array(True),
        "unit": np.eye(3, dtype=np.float32),
    }
    nodes = [
        helper.make_node("Slice", ["points", "start", "end", "axis"], ["first_points"]),
        helper.make_node("Slice", ["normals", "start", "end", "axis"], ["first_normals"]),
        helper.make_node("Mul", ["first_normals", "step"], ["along"]),
        helper.make_node("Add", ["first_points", "along"], ["vote_xyz"]),
        helper.make_node("ReduceMean", ["points", "axis"], ["mean"], keepdims=1),
    ]
    middle = "mean"
    if loops:
        scalar, vector = helper.make_tensor_value_info, [1, 1, 3]
        body = helper.make_graph(
            [
                helper.make_node("MatMul", ["x", "unit"], ["y"]),
                helper.make_node("Identity", ["go"], ["still"]),
            ],
            "body",
            [
                scalar("i", TensorProto.INT64, []),
                scalar("go", TensorProto.BOOL, []),
                scalar("x", TensorProto.FLOAT, vector),
            ],
            [scalar("still", TensorProto.BOOL, []), scalar("y", TensorProto.FLOAT, vector)],
        )
        nodes.append(helper.make_node("Loop", ["trips", "always", "mean"], ["looped"], body=body))
        middle = "looped"
    nodes += [
        helper.make_node("Add", [middle, "no_seed"], ["center_seed"]),
        helper.make_node("Add", [middle, "offsets"], ["center"]),
        helper.make_node("Identity", ["heat"], ["peak_heat"]),
        helper.make_node("Identity", ["quaternions"], ["quaternion"]),
        helper.make_node("Identity", ["logits"], ["class_logits"]),
        helper.make_node("Identity", ["score"], ["confidence"]),
    ]
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info(s.name, TensorProto.FLOAT, s.shape) for s in card.inputs],
        [helper.make_tensor_value_info(s.name, TensorProto.FLOAT, s.shape) for s in card.outputs],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    if metadata:
        helper.set_model_props(model, {"producer": "tests", CARD_KEY: card.core().to_json()})
    onnx.checker.check_model(model)
    return model


def tiny_cloud(count: int = 3000, seed: int = 0, center: Sequence[float] = (0.02, -0.03, 0.8)) -> NDArray[np.float32]:
    """A bumpy patch ``(count, 3)`` of 0.2 m around ``center``."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-0.1, 0.1, (count, 2))
    z = 0.01 * np.sin(60 * xy[:, 0]) * np.cos(50 * xy[:, 1])
    return (np.c_[xy, z] + center).astype(np.float32)


class MakeBundle(Protocol):
    """What the fixture ``make_bundle`` offers."""

    def __call__(
        self,
        name: str = "bundle",
        *,
        card: dict[str, Any] | None = None,
        graph: dict[str, Any] | None = None,
        golden: int = 1,
        change: Callable[[Path], None] | None = None,
    ) -> Path: ...


@pytest.fixture(scope="session")
def signing_keys(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A real key pair: paths of ``signing.key`` and ``signing.pub``; their folder may be ``ATTENTIONVOTE_KEYS``."""
    return make_keys(tmp_path_factory.mktemp("keys"))


@pytest.fixture(scope="session")
def trusted_key(signing_keys: tuple[Path, Path]) -> Path:
    """The public key that signs the bundles of ``make_bundle``."""
    return signing_keys[1]


@pytest.fixture(scope="session")
def make_card() -> Callable[..., ModelCard]:
    """:func:`tiny_card`."""
    return tiny_card


@pytest.fixture(scope="session")
def make_graph() -> Callable[..., Any]:
    """:func:`tiny_graph`."""
    return tiny_graph


@pytest.fixture(scope="session")
def make_cloud() -> Callable[..., NDArray[np.float32]]:
    """:func:`tiny_cloud`."""
    return tiny_cloud


@pytest.fixture
def make_bundle(tmp_path: Path, signing_keys: tuple[Path, Path]) -> MakeBundle:
    """Writes and signs a bundle in ``tmp_path / name`` and returns its folder.

    Args of the function:
        name: of the folder.
        card: changes of the card (see ``tiny_card``).
        graph: arguments of ``tiny_graph``, such as ``{"loops": 1_000_000}`` for a slow one.
        golden: number of golden clouds, answered by the real estimator.
        change: called with the folder before it is hashed and signed.
    """

    def make(
        name: str = "bundle",
        *,
        card: dict[str, Any] | None = None,
        graph: dict[str, Any] | None = None,
        golden: int = 1,
        change: Callable[[Path], None] | None = None,
    ) -> Path:
        folder = tmp_path / name
        (folder / "golden").mkdir(parents=True)
        described = tiny_card(**(card or {}))
        model = tiny_graph(described, **(graph or {})).SerializeToString(deterministic=True)
        (folder / "model.onnx").write_bytes(model)
        (folder / "card.json").write_text(described.to_json(), encoding="utf-8")
        (folder / "part.ply").write_bytes(PLY)
        quick = tiny_graph(described, **{**(graph or {}), "loops": 0}).SerializeToString(deterministic=True)
        with PoseEstimator(Bundle(folder, described, "0" * 64, quick)) as estimator:
            for i in range(golden):
                points = tiny_cloud(seed=i)
                answer = estimator.estimate(points)
                found = answer.detections if isinstance(answer, Estimate) else ()
                np.savez(
                    folder / "golden" / f"cloud_{i}.npz",
                    points=points,
                    camera_from_part=np.array([d.camera_from_part for d in found]).reshape(-1, 4, 4),
                    confidence=np.array([d.confidence for d in found], dtype=np.float32),
                )
        if change is not None:
            change(folder)
        write_manifest(folder, load_private_key(signing_keys[0]))
        return folder

    return make


@pytest.fixture
def bundle_folder(make_bundle: MakeBundle) -> Path:
    """An intact bundle."""
    return make_bundle()


@pytest.fixture
def other_card() -> ModelCard:
    """A card that differs from the tiny one."""
    return replace(tiny_card(), confidence_threshold=0.25)


def damage(whole: bytes, data: st.DataObject) -> bytes:
    """A file after some bytes were changed, removed or inserted; never empty."""
    content = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 6))):
        place = data.draw(st.integers(0, len(content) - 1))
        action = data.draw(st.sampled_from(["change", "remove", "insert"]))
        if action == "change":
            content[place] = data.draw(st.integers(0, 255))
        elif action == "remove":
            del content[place : place + data.draw(st.integers(1, 8))]
        else:
            content[place:place] = data.draw(
                st.binary(max_size=6) | st.sampled_from([b"9", b"\n", b"-1", b"nan ", b"\xa0"])
            )
        if not content:
            content = bytearray(b"p")
    return bytes(content)


@pytest.fixture(scope="session")
def damaged() -> Callable[[bytes, st.DataObject], bytes]:
    return damage
