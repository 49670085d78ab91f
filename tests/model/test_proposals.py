"""The heatmap without a grid against a dense convolution on a real grid, its peaks, and the gathering of votes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from attentionvote.model import proposals
from attentionvote.model.proposals import TIE, gather_votes, gather_votes_reference, heatmap_peaks, heatmap_reference

pytestmark = pytest.mark.usefixtures("kernels")

VOXEL = 2.0**-8  # metres; a power of two, so that whole voxels are exact in float32


def scattered(seed: int, count: int, extent: int = 6, samples: int = 1) -> Tensor:
    """Votes in a cube of ``extent`` voxels around the origin, several to a voxel, some at the same place."""
    rng = np.random.default_rng(seed)
    votes = rng.integers(-2 * extent, 2 * extent, (samples, count, 3)) * (VOXEL / 4) + VOXEL / 8
    return torch.from_numpy(votes.astype(np.float32))


def dense(votes: np.ndarray, window: int) -> tuple[np.ndarray, dict[tuple, float], dict[tuple, np.ndarray]]:
    """Heat of each vote's voxel, heat of each peak voxel, and the heat-weighted mean there, on a grid."""
    voxels = np.floor(votes / VOXEL).astype(int)
    low = voxels.min(0) - window - 1
    shape = voxels.max(0) - low + window + 2
    counts, sums = np.zeros(shape), np.zeros((*shape, 3))
    np.add.at(counts, tuple((voxels - low).T), 1.0)
    np.add.at(sums, tuple((voxels - low).T), votes)
    steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
    kernel = np.exp(-0.5 * (steps**2).sum(1))
    kernel /= kernel.sum()
    heat, mean = np.zeros(shape), np.zeros((*shape, 3))
    for weight, step in zip(kernel, steps, strict=True):
        heat += weight * np.roll(counts, step, (0, 1, 2))
        mean += weight * np.roll(sums, step, (0, 1, 2))
    peaks, means = {}, {}
    order = {tuple(v): i for i, v in reversed(list(enumerate(voxels - low)))}  # first vote of each voxel
    for at, first in order.items():
        near = [o for o in order if max(abs(a - b) for a, b in zip(o, at, strict=True)) <= window]
        if all((round(heat[at], 9), -first) >= (round(heat[o], 9), -order[o]) for o in near):
            key = tuple(int(v) for v in at + low)
            peaks[key], means[key] = heat[at], mean[at] / heat[at]
    return heat[tuple((voxels - low).T)], peaks, means


def test_kernel_has_the_papers_values() -> None:
    corner = [proposals.CENTER * proposals.SIDE**k for k in range(4)]
    np.testing.assert_allclose(corner, [0.0923, 0.0560, 0.0339, 0.0206], atol=5e-5)
    np.testing.assert_allclose(np.dot(corner, [1, 6, 12, 8]), 1.0, rtol=1e-12)


@pytest.mark.parametrize(("count", "accepted"), [(4, False), (5, True)])
def test_the_papers_threshold_is_reached_by_five_votes_in_one_voxel(count: int, accepted: bool) -> None:
    # 0.4 = 4.3 votes at 0.0923 each.
    peaks = heatmap_peaks(torch.full((1, count, 3), 0.3 * VOXEL), VOXEL, 1)
    assert (peaks.heat[0, 0].item() >= 0.4) == accepted
    np.testing.assert_allclose(peaks.heat[0, 0], count * 0.092261, rtol=1e-5)


@settings(max_examples=40)
@given(st.integers(0, 2**31), st.integers(1, 60), st.sampled_from([1, 2]))
def test_heat_and_peaks_equal_a_dense_convolution(seed: int, count: int, window: int) -> None:
    votes = scattered(seed, count)
    heat, expected, means = dense(votes[0].double().numpy(), window)
    for center_seed in ("voxel", "mean"):
        peaks = heatmap_peaks(votes, VOXEL, 64, window, center_seed)
        np.testing.assert_allclose(peaks.vote_heat[0], heat, rtol=1e-5)
        real = peaks.heat[0] > 0
        assert int(real.sum()) == len(expected)
        assert (peaks.heat[0].diff() <= TIE).all()  # equal heats are in the order of their votes
        at = {tuple(int(c) for c in np.floor(s / VOXEL)): (h, s) for s, h in zip(
            heatmap_peaks(votes, VOXEL, 64, window, "voxel").center_seed[0, real].double().numpy(),
            peaks.heat[0, real].tolist(), strict=True,
        )}  # fmt: skip
        assert at.keys() == expected.keys()
        for key, value in expected.items():
            np.testing.assert_allclose(at[key][0], value, rtol=1e-5)
            np.testing.assert_allclose(at[key][1], (np.array(key) + 0.5) * VOXEL, atol=1e-7)
    # The weighted means, hottest first; equal heats may come in any order, so compare as sets.
    seeds = peaks.center_seed[0, real].double().numpy()
    wanted = np.array(list(means.values()))
    apart = np.linalg.norm(seeds[:, None] - wanted, axis=-1)
    np.testing.assert_allclose(apart.min(0), 0, atol=1e-7)
    np.testing.assert_allclose(apart.min(1), 0, atol=1e-7)


@settings(max_examples=50)
@given(st.integers(0, 2**31), st.integers(1, 80), st.sampled_from([1, 2, 3]), st.sampled_from([2, 6, 20]))
def test_kernel_equals_reference(seed: int, count: int, window: int, extent: int) -> None:
    votes = scattered(seed, count, extent, samples=2)
    actual, expected = proposals.Heatmap()(votes, VOXEL, window), heatmap_reference(votes, VOXEL, window)
    torch.testing.assert_close(actual[0], expected[0], rtol=1e-5, atol=0)
    torch.testing.assert_close(actual[1], expected[1], rtol=0, atol=0)
    torch.testing.assert_close(actual[2], expected[2], rtol=0, atol=1e-7)


def test_two_equal_peaks_far_apart_both_stay_and_near_ones_merge() -> None:
    group = torch.zeros(5, 3)
    for gap, found in ((1, 1), (2, 1), (3, 2)):
        votes = torch.cat([group, group + torch.tensor([gap * VOXEL, 0, 0])])[None] + VOXEL / 2
        assert int((heatmap_peaks(votes, VOXEL, 8, window=2).heat > 0).sum()) == found
    first = heatmap_peaks(votes, VOXEL, 8, window=3, center_seed="voxel").center_seed[0, 0]
    torch.testing.assert_close(first, torch.full((3,), VOXEL / 2))


def test_fewer_peaks_than_wanted_are_filled_up_without_heat() -> None:
    peaks = heatmap_peaks(torch.zeros(1, 20, 3), VOXEL, 16)
    assert peaks.heat.shape == (1, 16)
    assert (peaks.heat[0, 1:] == 0).all()
    assert peaks.center_seed.isfinite().all()


@given(st.integers(0, 2**31), st.sampled_from(["voxel", "mean"]))
def test_peaks_move_with_the_votes_by_whole_voxels(seed: int, center_seed: str) -> None:
    votes = scattered(seed, 40)
    shift = torch.tensor([3.0, -40.0, 130.0]) * VOXEL
    still, moved = (heatmap_peaks(v, VOXEL, 8, 2, center_seed) for v in (votes, votes + shift))
    torch.testing.assert_close(moved.heat, still.heat, rtol=1e-6, atol=0)
    real = still.heat > 0
    torch.testing.assert_close(moved.center_seed[real], (still.center_seed + shift)[real], rtol=0, atol=1e-6)


@given(st.integers(0, 2**31))
def test_peaks_do_not_depend_on_the_other_samples(seed: int) -> None:
    votes = scattered(seed, 30, samples=3)
    together = heatmap_peaks(votes, VOXEL, 8, 2, "mean")
    for i in range(3):
        alone = heatmap_peaks(votes[i : i + 1], VOXEL, 8, 2, "mean")
        for a, b in zip(alone, together, strict=True):
            assert torch.equal(a[0], b[i])


@given(st.integers(0, 2**31), st.integers(1, 40), st.integers(1, 12), st.sampled_from([1, 2, 4]))
def test_gathered_votes_equal_a_loop(seed: int, votes: int, count: int, radius: int) -> None:
    cast, seeds = scattered(seed, votes, 3, 2), scattered(seed + 1, 5, 4, 2)
    index = gather_votes(cast, seeds, radius * VOXEL, count)
    torch.testing.assert_close(index, gather_votes_reference(cast, seeds, radius * VOXEL, count))
    for sample in range(2):
        for row, seed_xyz in enumerate(seeds[sample].double().numpy()):
            squared = ((cast[sample].double().numpy() - seed_xyz) ** 2).sum(1)
            inside = np.flatnonzero(squared <= (radius * VOXEL) ** 2)[:count]
            actual = index[sample, row].tolist()
            if len(inside):
                assert actual == [inside[k % len(inside)] for k in range(count)]
            else:
                assert len(set(actual)) == 1
                assert squared[actual[0]] == squared.min()
