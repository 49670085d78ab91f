"""The session runs what fits its card, side by side, and stops when a deadline passes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.inference.errors import BundleError, DeadlineExceeded
from attentionvote.inference.runtime import Session, runtime_version

MakeCard = Callable[..., ModelCard]
MakeGraph = Callable[..., Any]
ENDLESS = {"loops": 200_000_000}  # minutes


def inputs(card: ModelCard, seed: int = 0) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Random inputs of a card's graph."""
    rng = np.random.default_rng(seed)
    shape = (1, card.points, 3)
    return rng.normal(size=shape).astype(np.float32), rng.normal(size=shape).astype(np.float32)


def test_a_run_gives_every_output_of_the_card(make_card: MakeCard, make_graph: MakeGraph) -> None:
    card = make_card()
    points, normals = inputs(card)
    outputs = Session(make_graph(card).SerializeToString(), card).run(points, normals)
    assert list(outputs) == [spec.name for spec in card.outputs]
    for spec in card.outputs:
        assert outputs[spec.name].shape == spec.shape
        assert outputs[spec.name].dtype == np.float32
    np.testing.assert_allclose(outputs["center"][0, 0], points[0].mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(outputs["vote_xyz"], points[:, :64] + 0.01 * normals[:, :64], atol=1e-6)


def test_bytes_that_are_no_graph_are_one_sentence(make_card: MakeCard) -> None:
    for content in (b"", b"junk", bytes(1000)):
        with pytest.raises(
            BundleError, match=f"must be a graph that onnxruntime {runtime_version()} can load"
        ) as caught:
            Session(content, make_card())
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"points": 512},
            r"input points as tensor\(float\) of shape \(1, 512, 3\), got tensor\(float\) of shape \(1, 256, 3\)",
        ),
        ({"votes": 32}, r"output vote_xyz as tensor\(float\) of shape \(1, 32, 3\)"),
        ({"proposals": 8}, r"output center_seed as tensor\(float\) of shape \(1, 8, 3\)"),
        ({"classes": ("a", "b")}, r"output class_logits as tensor\(float\) of shape \(1, 4, 2\)"),
    ],
)
def test_a_graph_of_other_shapes_than_the_cards_is_refused(
    make_card: MakeCard, make_graph: MakeGraph, changes: dict[str, Any], message: str
) -> None:
    card = make_card()
    with pytest.raises(BundleError, match=message):
        Session(make_graph(card).SerializeToString(), replace(card, **changes))


def test_a_graph_with_other_names_or_a_moving_shape_is_refused(make_card: MakeCard, make_graph: MakeGraph) -> None:
    card = make_card()
    renamed = make_graph(card)
    renamed.graph.output[2].name = renamed.graph.node[-4].output[0] = "heat_of_peak"
    with pytest.raises(
        BundleError, match=r"must have the outputs vote_xyz, .*; got vote_xyz, center_seed, heat_of_peak"
    ):
        Session(renamed.SerializeToString(), card)
    free = make_graph(card)
    free.graph.input[0].type.tensor_type.shape.dim[1].dim_param = "N"
    with pytest.raises(BundleError, match=r"input points .*, got tensor\(float\) of shape \(1, 'N', 3\)"):
        Session(free.SerializeToString(), card)
    double = make_graph(card)
    double.graph.input.append(onnx.helper.make_tensor_value_info("more", onnx.TensorProto.FLOAT, [1]))
    with pytest.raises(BundleError, match="must have the inputs points, normals; got points, normals, more"):
        Session(double.SerializeToString(), card)


def test_other_inputs_are_refused_before_the_run(make_card: MakeCard, make_graph: MakeGraph) -> None:
    card = make_card()
    session = Session(make_graph(card).SerializeToString(), card)
    points, normals = inputs(card)
    with pytest.raises(ValueError, match=r"points must be float32 of shape \(1, 256, 3\), got float64"):
        session.run(points.astype(np.float64), normals)  # type: ignore[arg-type]
    with pytest.raises(
        ValueError, match=r"normals must be float32 of shape \(1, 256, 3\), got float32 of shape \(256, 3\)"
    ):
        session.run(points, normals[0])


def test_a_deadline_stops_the_graph_and_not_only_the_wait(make_card: MakeCard, make_graph: MakeGraph) -> None:
    card = make_card()
    session = Session(make_graph(card, **ENDLESS).SerializeToString(), card)
    start, worked = time.monotonic(), time.process_time()
    with pytest.raises(DeadlineExceeded, match=r"stopped after its deadline of 0\.200 s"):
        session.run(*inputs(card), deadline_s=0.2)
    assert 0.2 <= time.monotonic() - start < 2
    # Were the graph still running in the background, its thread would use the processor while this one sleeps.
    worked = time.process_time()
    time.sleep(0.3)
    assert time.process_time() - worked < 0.1


def test_a_session_works_after_a_stopped_run(make_card: MakeCard, make_graph: MakeGraph) -> None:
    card = make_card()
    session = Session(make_graph(card, loops=100_000).SerializeToString(), card)
    before = session.run(*inputs(card))
    with pytest.raises(DeadlineExceeded):
        session.run(*inputs(card), deadline_s=0.01)
    after = session.run(*inputs(card), deadline_s=60)
    np.testing.assert_array_equal(before["center"], after["center"])


@pytest.mark.parametrize("deadline_s", [0.0, -1.0, float("nan")])
def test_a_deadline_that_has_passed_starts_nothing(
    make_card: MakeCard, make_graph: MakeGraph, deadline_s: float
) -> None:
    card = make_card()
    session = Session(make_graph(card, **ENDLESS).SerializeToString(), card)
    with pytest.raises(DeadlineExceeded, match="before the graph was started"):
        session.run(*inputs(card), deadline_s=deadline_s)


def test_a_very_late_deadline_is_no_error_and_leaves_no_thread(make_card: MakeCard, make_graph: MakeGraph) -> None:
    card = make_card()
    session = Session(make_graph(card).SerializeToString(), card)
    before = threading.active_count()
    for deadline_s in (1e30, float("inf"), 3600.0):
        session.run(*inputs(card), deadline_s=deadline_s)
    deadline = time.monotonic() + 5
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.01)
    assert threading.active_count() <= before


def test_runs_side_by_side_do_not_disturb_each_other(make_card: MakeCard, make_graph: MakeGraph) -> None:
    card = make_card()
    session = Session(make_graph(card, loops=2000).SerializeToString(), card)
    alone = [session.run(*inputs(card, seed)) for seed in range(4)]
    wrong = []

    def work(seed: int) -> None:
        for _ in range(20):
            outputs = session.run(*inputs(card, seed), deadline_s=60)
            if any(not np.array_equal(outputs[name], alone[seed][name]) for name in outputs):
                wrong.append(seed)

    threads = [threading.Thread(target=work, args=[seed]) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_one_stopped_run_leaves_the_one_beside_it_alone(make_card: MakeCard, make_graph: MakeGraph) -> None:
    card = make_card()
    session = Session(make_graph(card, loops=300_000).SerializeToString(), card)
    answers: list[object] = []
    other = threading.Thread(target=lambda: answers.append(session.run(*inputs(card))))
    other.start()
    with pytest.raises(DeadlineExceeded):
        session.run(*inputs(card), deadline_s=0.05)
    other.join()
    assert len(answers) == 1
