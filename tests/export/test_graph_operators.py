"""The operators that are written into the graph, each alone in onnxruntime beside the C code: the same indices."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import onnx_ir as ir
import onnxruntime
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from attentionvote.export import graph_farthest_points, graph_neighbors, graph_operators
from attentionvote.geometry.sampling import farthest_point_order, level_neighbors

KINDS = ("uniform", "lattice", "repeated", "one place", "stray", "line", "plane", "two heaps", "far", "farthest")


def session(
    name: str,
    points: int,
    shapes: Sequence[Sequence[int]],
    options: onnxruntime.SessionOptions | None = None,
    **attributes: Any,
) -> onnxruntime.InferenceSession:
    """One operator as a graph."""
    inputs = [graph_operators.value("points", graph_operators.FLOAT, [points, 3])]
    if name == "Neighborhoods":
        inputs += [graph_operators.value(f"given_{i}", graph_operators.INT, shape) for i, shape in enumerate(shapes)]
    outputs = [graph_operators.value(f"output_{i}", graph_operators.INT, shape) for i, shape in enumerate(shapes)]
    convert = ir.convenience.convert_attributes(attributes)
    node = ir.Node("attentionvote", name, inputs, attributes=convert, outputs=outputs)
    graph = ir.Graph(inputs, outputs, nodes=[node], opset_imports={"": graph_operators.OPSET, "attentionvote": 1})
    model = ir.Model(graph, ir_version=10)
    graph_operators.write_out(model)
    graph_operators.make_optional(model, [given.name for given in inputs[1:] if given.name])
    assert {n.domain for n in model.graph} == {""}
    return onnxruntime.InferenceSession(ir.to_proto(model).SerializeToString(), options)


def cloud(kind: str, count: int) -> NDArray[np.float32]:
    rng = np.random.default_rng(count)
    points = rng.uniform([-0.1, -0.1, 0.7], [0.1, 0.1, 0.9], (count, 3))
    if kind == "lattice":  # hundreds of equal distances, exact in float32
        points = rng.integers(-6, 6, (count, 3)) * 2.0**-7 + [0, 0, 0.75]
    elif kind == "repeated":
        points = points[rng.integers(0, max(1, count // 20), count)]
    elif kind == "one place":
        points = np.full((count, 3), 0.5)
    elif kind == "stray":
        points[::50] += rng.normal(size=(len(points[::50]), 3)) * 30
    elif kind == "line":
        points[:, :2] = 0.1
    elif kind == "plane":
        points[:, 2] = 0.7
    elif kind in ("far", "farthest"):  # beyond what float32 can square
        points[::100] = 1e20 if kind == "far" else np.finfo(np.float32).max
    elif kind == "two heaps":
        points[::2] += [5.0, 0.0, 0.0]
    return points.astype(np.float32)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("points", "count"), [(1, 1), (2, 2), (31, 31), (64, 10), (65, 65), (700, 300), (9000, 600)])
def test_farthest_points_are_those_of_the_c_code(kind: str, points: int, count: int) -> None:
    xyz = cloud(kind, points)
    (found,) = session("FarthestPoints", points, [[count]], count=count).run(None, {"points": xyz})
    np.testing.assert_array_equal(found, farthest_point_order(xyz, count))


SMALL = 40
SPOTS = st.integers(-3, 3).map(lambda n: n * 0.125)


@cache
def tied() -> onnxruntime.InferenceSession:
    """With a table that most ties do not fit in."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(graph_farthest_points, "CANDIDATES", 8)
        return session("FarthestPoints", SMALL, [[SMALL]], count=SMALL)


@settings(deadline=None, max_examples=150)
@given(arrays(np.float32, (SMALL, 3), elements=SPOTS))
def test_ties_and_repetitions_of_every_kind(xyz: NDArray[np.float32]) -> None:
    """On a coarse lattice nearly every choice is a tie, and most points stand where another one stands."""
    (found,) = tied().run(None, {"points": xyz})
    np.testing.assert_array_equal(found, farthest_point_order(xyz, SMALL))


EDGES = ([30, 20, 10, 5], [12, 8, 6, 4], [0.125, 0.25, 0.375, 0.5])


@cache
def edges() -> onnxruntime.InferenceSession:
    shapes = [EDGES[0][:1], *([c, k] for c, k in zip(*EDGES[:2], strict=True))]
    return session("Neighborhoods", 300, shapes, centers=EDGES[0], neighbors=EDGES[1], radii=EDGES[2])


@settings(deadline=None, max_examples=50)
@given(arrays(np.float32, (300, 3), elements=st.integers(-8, 8).map(lambda n: n * 0.125)))
def test_a_point_at_exactly_the_radius_is_inside(xyz: NDArray[np.float32]) -> None:
    """Of a ball, and the box of its block is within reach of the centres'."""
    order, *found = edges().run(None, {"points": xyz})
    expected, neighbors = level_neighbors(xyz, *EDGES)
    for actual, wanted in zip([order, *found], [expected, *neighbors], strict=True):
        np.testing.assert_array_equal(actual, wanted)


def test_a_table_smaller_than_the_ties_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """More points are equally far than the table holds, and chains of who lowers whom are longer than the passes."""
    monkeypatch.setattr(graph_farthest_points, "CANDIDATES", 4)
    monkeypatch.setattr(graph_farthest_points, "PASSES", 0)
    for kind in KINDS:
        xyz = cloud(kind, 300)
        (found,) = session("FarthestPoints", 300, [[200]], count=200).run(None, {"points": xyz})
        np.testing.assert_array_equal(found, farthest_point_order(xyz, 200))


@pytest.mark.parametrize(
    ("kind", "most"), [("uniform", 50), ("lattice", 50), ("repeated", 150), ("plane", 50), ("two heaps", 50)]
)
def test_a_round_chooses_many_points(kind: str, most: int, tmp_path: Path) -> None:
    """What the operator is for. Where every point is there twenty times, so it is among the candidates."""
    options = onnxruntime.SessionOptions()
    options.enable_profiling, options.profile_file_prefix = True, str(tmp_path / "rounds")
    model = session("FarthestPoints", 9000, [[600]], options, count=600)
    model.run(None, {"points": cloud(kind, 9000)})
    events = json.loads(Path(model.end_profiling()).read_text())
    rounds = sum("round/MatMul_node" in e["name"] for e in events) / (graph_farthest_points.PASSES + 1)
    assert 0 < rounds < most


@pytest.mark.parametrize("threads", [1, 4])
def test_several_threads_find_the_same(threads: int) -> None:
    xyz = cloud("uniform", 9000)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    model = session("FarthestPoints", 9000, [[600]], options, count=600)
    for _ in range(5):
        np.testing.assert_array_equal(model.run(None, {"points": xyz})[0], farthest_point_order(xyz, 600))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("points", [20, 700, 9000])
def test_neighbourhoods_are_those_of_the_c_code(kind: str, points: int) -> None:
    xyz = cloud(kind, points)
    centers, neighbors, radii = [19, 16, 9, 1], [24, 40, 8, 3], [0.03, 0.05, 0.08, 0.2]
    shapes = [centers[:1], *([c, k] for c, k in zip(centers, neighbors, strict=True))]
    model = session("Neighborhoods", points, shapes, centers=centers, neighbors=neighbors, radii=radii)
    expected, lists = level_neighbors(xyz, centers, neighbors, radii)
    for actual, wanted in zip(model.run(None, {"points": xyz}), [expected, *lists], strict=True):
        np.testing.assert_array_equal(actual, wanted)


def test_more_points_than_there_are_cannot_be_chosen() -> None:
    with pytest.raises(ValueError, match=r"count must lie in 1..20 \(the number of points\), got 21"):
        session("FarthestPoints", 20, [[21]], count=21)


def test_outside_of_a_trace_the_operators_answer_zeros() -> None:
    assert graph_neighbors.farthest_point_order(torch.rand(50, 3), 7).tolist() == [0] * 7
