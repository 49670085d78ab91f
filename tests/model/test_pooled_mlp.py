"""The C kernel of the shared MLP and its maximum against plain torch: values and gradients."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from attentionvote.model import pooled_mlp as pooled_mlp_module
from attentionvote.model.pooled_mlp import pooled_mlp, pooled_mlp_reference

pytestmark = pytest.mark.usefixtures("kernels")

# (centers, neighbors, channels, widths): rows not divisible by the kernel's 4, widths not by its 16, one of each.
SHAPES = [
    (1, 1, 10, (8, 8)),
    (5, 3, 10, (16, 24)),
    (7, 2, 6, (24, 8, 40)),
    (3, 5, 1, (8, 16, 8, 16)),
    (4, 7, 10, (32, 64)),
    (2, 255, 10, (8, 8)),
    (9, 16, 10, (40, 40, 16)),
    (6, 16, 10, (64, 32, 96, 32)),  # whole tiles where the processor has AVX-512
    (3, 24, 10, (32, 40, 64, 64)),  # tiles above and below a layer without
    (0, 4, 10, (8, 8)),
]


def arguments(
    centers: int, neighbors: int, channels: int, widths: Sequence[int], seed: int = 0, whole: bool = False
) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
    """Random inputs; ``whole`` ones are small integers, so that sums are exact and ties in the maximum frequent."""
    rng = np.random.default_rng(seed)

    def draw(*shape: int) -> Tensor:
        values = rng.integers(-1, 2, shape) if whole else rng.normal(size=shape)
        return torch.from_numpy(values.astype(np.float32))

    sizes = [channels, *widths]
    weights = [t for a, b in zip(sizes, widths, strict=False) for t in (draw(b, a) / (1 if whole else a**0.5), draw(b))]
    sources = 6
    # Six sources for up to 255 neighbours: repeated neighbours are the rule.
    index = torch.from_numpy(rng.integers(0, sources, (centers, neighbors)))
    return draw(centers, neighbors, channels), draw(sources, widths[0]), index, weights


def run(function: object, geometry: Tensor, projected: Tensor | None, index: Tensor, weights: list[Tensor]) -> list:
    """Value, and gradients of a random linear form of it."""
    leaves = [t.clone().requires_grad_() for t in ([] if projected is None else [projected]) + weights]
    own = None if projected is None else leaves[0]
    value = function(geometry, own, index, leaves if projected is None else leaves[1:])  # type: ignore[operator]
    direction = torch.from_numpy(np.random.default_rng(1).normal(size=value.shape).astype(np.float32))
    direction[:, ::3] = 0  # as behind a ReLU
    return [value.detach(), *torch.autograd.grad((value * direction).sum(), leaves)]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("with_features", [True, False], ids=["features", "none"])
def test_kernel_equals_reference(shape: tuple, with_features: bool) -> None:
    geometry, projected, index, weights = arguments(*shape)
    given = projected if with_features else None
    actual, expected = (run(f, geometry, given, index, weights) for f in (pooled_mlp, pooled_mlp_reference))
    for a, b in zip(actual, expected, strict=True):
        # Sums of up to 1,500 float32 products in another order.
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_of_equal_maxima_the_first_neighbour_gets_the_gradient(seed: int) -> None:
    geometry, projected, index, weights = arguments(6, 7, 4, (8, 8), seed, whole=True)
    hidden = torch.relu(torch.nn.functional.linear(geometry, *weights[:2]) + projected[index])
    last = torch.nn.functional.linear(hidden, *weights[2:])
    ties = (last == last.amax(1, keepdim=True)).sum(1) > 1
    assert ties.float().mean() > 0.2
    actual, expected = (run(f, geometry, projected, index, weights) for f in (pooled_mlp, pooled_mlp_reference))
    for a, b in zip(actual, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5)


def test_empty_input_gives_the_biases() -> None:
    _, _, index, weights = arguments(5, 3, 10, (16, 24))
    value = pooled_mlp(torch.zeros(5, 3, 10), torch.zeros(6, 16), index, weights)
    expected = weights[2] @ torch.relu(weights[1]) + weights[3]
    torch.testing.assert_close(value, expected.expand(5, -1), rtol=1e-5, atol=1e-5)


def test_repeated_neighbours_change_nothing() -> None:
    geometry, projected, index, weights = arguments(6, 3, 10, (16, 24))
    padded = [torch.cat([t, t[:, :1], t[:, :1]], dim=1) for t in (geometry, index)]
    short = run(pooled_mlp, geometry, projected, index, weights)
    long = run(pooled_mlp, padded[0], projected, padded[1], weights)
    for a, b in zip(short, long, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("first_only", [False, True], ids=["in turn", "the first"])
@pytest.mark.parametrize("distinct", [1, 3, 8, 13])
@pytest.mark.parametrize("other", [None, 13, 15])
def test_what_repeats_is_left_out_and_nothing_else(distinct: int, first_only: bool, other: int | None) -> None:
    """A ball with fewer points than places; ``other``: one place that is another neighbour after all."""
    geometry, projected, index, weights = arguments(6, 16, 10, (32, 64))
    place = torch.arange(16) % distinct if not first_only else torch.arange(16) * (torch.arange(16) < distinct)
    geometry, index = geometry[:, place].contiguous(), index[:, place].contiguous()
    if other is not None:
        geometry[::2, other] += 1  # another place
        index[1::2, other] = (index[1::2, other] + 1) % 6  # the same place, other features
    actual, expected = (run(f, geometry, projected, index, weights) for f in (pooled_mlp, pooled_mlp_reference))
    for a, b in zip(actual, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


@pytest.fixture
def three_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("three_threads")
def test_threads_share_the_rows_and_add_up_the_gradients() -> None:
    inputs = arguments(200, 3, 10, (8, 16))
    actual, expected = run(pooled_mlp, *inputs), run(pooled_mlp_reference, *inputs)
    for a, b in zip(actual, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


def test_geometry_gets_no_gradient() -> None:
    geometry, projected, index, weights = arguments(3, 4, 10, (8, 8))
    geometry.requires_grad_()
    weights[0].requires_grad_()
    pooled_mlp(geometry, projected, index, weights).sum().backward()
    assert geometry.grad is None
    assert weights[0].grad is not None


def used_kernel(value: Tensor) -> bool:
    return value.grad_fn is not None and "PooledMLP" in value.grad_fn.name()


@pytest.mark.parametrize(
    ("shape", "fits"),
    [
        ((3, 4, 10, (8, 8)), True),
        ((3, 4, 10, (8, 12)), False),
        ((3, 4, 10, (16,)), False),
        ((2, 256, 10, (8, 8)), False),
        ((2, 3, 10, (8,) * 9), True),
        ((2, 3, 10, (8,) * 10), False),  # the kernel has room for nine layers
    ],
    ids=str,
)
def test_what_the_kernel_cannot_do_takes_the_reference(shape: tuple, fits: bool) -> None:
    geometry, projected, index, weights = arguments(*shape)
    weights[0].requires_grad_()
    value = pooled_mlp(geometry, projected, index, weights)
    assert used_kernel(value) == fits
    torch.testing.assert_close(value, pooled_mlp_reference(geometry, projected, index, weights), rtol=1e-4, atol=1e-4)


def test_double_precision_takes_the_reference() -> None:
    geometry, projected, index, weights = arguments(3, 4, 10, (8, 8))
    wide = [t.double() for t in weights]
    value = pooled_mlp(geometry.double(), projected.double(), index, wide)
    assert value.dtype == torch.float64
    torch.testing.assert_close(value.float(), pooled_mlp(geometry, projected, index, weights), rtol=1e-4, atol=1e-5)


def test_half_precision_features_take_the_reference() -> None:
    # Under autocast the projection is bfloat16 beside float32 geometry; read as float32 it would be noise.
    geometry, projected, index, weights = arguments(3, 4, 10, (8, 8))
    exact = pooled_mlp(geometry, projected, index, weights)
    rounded = pooled_mlp(geometry, projected.bfloat16(), index, weights)
    torch.testing.assert_close(rounded, exact, rtol=0.05, atol=0.05)


def test_32_bit_indices_give_the_same() -> None:
    geometry, projected, index, weights = arguments(5, 3, 10, (16, 24))
    expected = pooled_mlp(geometry, projected, index, weights)
    actual = pooled_mlp(geometry, projected, index.int(), weights)
    torch.testing.assert_close(actual, expected, rtol=1e-5, atol=1e-5)


def test_weights_stored_column_by_column_give_the_same() -> None:
    geometry, projected, index, weights = arguments(5, 3, 10, (16, 24))

    def transposed(_: object, own: Tensor, where: Tensor, leaves: list[Tensor]) -> Tensor:
        return pooled_mlp(geometry, own, where, [w.T.contiguous().T if w.ndim == 2 else w for w in leaves])

    actual = run(transposed, geometry, projected, index, weights)
    for a, b in zip(actual, run(pooled_mlp_reference, geometry, projected, index, weights), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


def test_the_libraries_are_those_of_this_package(kernels: dict[str, ctypes.CDLL]) -> None:
    for file, names in {
        "pooled_mlp.c": ("pooled_forward", "pooled_backward"),
        "network_ops.c": (
            "pair_features",
            "interpolate",
            "interpolate_backward",
            "points_in_box",
            "votes_around",
            "heatmap",
        ),
    }.items():
        assert all(hasattr(kernels[file], name) for name in names)


@pytest.mark.parametrize("most", [1, 16 * 8 * 2])
def test_without_a_gradient_it_goes_piece_by_piece(monkeypatch: pytest.MonkeyPatch, most: int) -> None:
    geometry, projected, index, weights = arguments(5, 8, 10, (16, 16))
    inputs = geometry.double(), projected.double(), index, [w.double() for w in weights]
    whole, pieces = pooled_mlp_reference(*inputs), []

    def counted(piece: Tensor, *rest: Any) -> Tensor:
        pieces.append(len(piece))
        return pooled_mlp_reference(piece, *rest)

    monkeypatch.setattr(pooled_mlp_module, "MOST_NUMBERS", most)
    monkeypatch.setattr(pooled_mlp_module, "pooled_mlp_reference", counted)
    with torch.no_grad():
        torch.testing.assert_close(pooled_mlp(*inputs), whole, rtol=1e-14, atol=1e-14)
    assert pieces == {1: [1] * 5, 256: [2, 2, 1]}[most]
    pieces.clear()
    assert torch.equal(pooled_mlp(*inputs), whole)
    assert pieces == [5]  # a backward pass needs all of it
