"""Which rays are cast: nothing that could change a hit is left out, and the draws are numpy's."""

from __future__ import annotations

import shutil
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from attentionvote.geometry import native
from attentionvote.geometry.pose import rotation_about, transform
from attentionvote.simulation.camera import Camera
from attentionvote.simulation.ray_selection import FirstHits, Windows, random_order
from attentionvote.simulation.raycast import BinSurface, PartCaster

Heap = Callable[..., NDArray]


@pytest.fixture(autouse=True)
def compiled() -> None:
    if shutil.which("cc") is None:
        pytest.skip("no C compiler on this machine")
    assert native.load("attentionvote.simulation", "rays.c") is not None


@given(st.integers(0, 3000), st.integers(0, 1000))
@example(0, 0)
@example(1, 0)
@example(256, 0)
@example(257, 0)
@example(70_000, 0)
def test_the_random_order_and_the_draws_after_it_are_numpys(count: int, seed: int) -> None:
    ours, numpys = np.random.default_rng(seed), np.random.default_rng(seed)
    ours.integers(0, 9, seed % 2, dtype=np.uint32)  # half a 64-bit draw may be left over
    numpys.integers(0, 9, seed % 2, dtype=np.uint32)
    order = random_order(count, ours)
    assert order.dtype == np.int32
    np.testing.assert_array_equal(order, numpys.permutation(count))
    assert ours.bit_generator.state == numpys.bit_generator.state
    with native.disabled():
        np.testing.assert_array_equal(random_order(count, ours), numpys.permutation(count))


@pytest.mark.parametrize("count", [3, 400, 20_000])
def test_selected_rays_have_the_hits_of_all(caster: PartCaster, heap: Heap, count: int) -> None:
    """Also a bound so narrow that one ray would be left alone: it is turned with the others of its box."""
    poses, xy = heap(12), np.random.default_rng(count).uniform(-0.2, 0.2, (count, 2))
    selected = caster.cast(poses, xy)
    with native.disabled():
        everything = caster.cast(poses, xy)
    np.testing.assert_array_equal(selected.depth, everything.depth)
    np.testing.assert_array_equal(selected.instance, everything.instance)
    np.testing.assert_array_equal(selected.normal, everything.normal)
    assert count < 400 or (selected.instance >= 0).sum() > count / 50


def test_instances_at_one_place_are_told_apart_by_their_index(caster: PartCaster, heap: Heap) -> None:
    xy = np.random.default_rng(0).uniform(-0.2, 0.2, (3000, 2))
    for poses in (np.repeat(heap(3), 2, axis=0), np.tile(heap(3), (2, 1, 1))):
        twins = caster.cast(poses, xy).instance
        first = np.array([next(i for i in range(6) if (poses[i] == pose).all()) for pose in poses])
        assert np.isin(twins[twins >= 0], first).all()
        with native.disabled():
            np.testing.assert_array_equal(twins, caster.cast(poses, xy).instance)


def test_windows_hold_the_outline_and_what_is_hidden_is_not_selected() -> None:
    rng = np.random.default_rng(0)
    turn = np.array([[np.cos(0.5), -np.sin(0.5), 0], [np.sin(0.5), np.cos(0.5), 0], [0, 0, 1]])
    rod = rng.uniform(-1, 1, (500, 3)) * (0.1, 0.005, 0.005) @ turn.T + (0, 0, 0.5)
    windows = Windows.empty(1)
    windows.fill(np.array([True]), rod[None])
    seen = rod[:, :2] / rod[:, 2:]
    across = seen @ windows.across[0]
    assert (across >= windows.low_across).all()
    assert (across <= windows.high_across).all()
    assert np.ptp(across) < 0.03  # of a rod 0.4 long
    assert windows.near[0] < rod[:, 2].min()

    xy = np.concatenate([seen, rng.uniform(-0.3, 0.3, (5000, 2))])
    hits = FirstHits(xy)
    (first,), (last,) = hits.slices(windows)
    chosen, rays = hits.select(windows, 0, first, last)
    assert set(range(500)) <= set(hits.order[chosen])
    assert len(chosen) < 1000
    np.testing.assert_array_equal(rays, np.c_[xy[hits.order[chosen]], np.ones(len(chosen))].astype(np.float32))
    chosen = chosen.copy()
    hits.keep(chosen[::2], np.full(len(chosen[::2]), 0.4, np.float32), np.zeros(len(chosen[::2]), np.int32), 1)
    np.testing.assert_array_equal(hits.select(windows, 0, first, last)[0], chosen[1::2])


@pytest.mark.parametrize("seed", range(4))
def test_the_bin_has_the_same_depth_in_c(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = rotation_about((1, 0, 0), np.pi + rng.uniform(-0.9, 0.9)) @ rotation_about((0, 0, 1), rng.uniform(-3, 3))
    surface = BinSurface(np.array([0.3, 0.2, 0.1]), transform(turn, (*rng.uniform(-0.1, 0.1, 2), 0.6)))
    xy = rng.uniform(-0.7, 0.7, (5000, 2))
    depth = surface.depth(xy)
    with native.disabled():
        np.testing.assert_array_equal(depth, surface.depth(xy))
    assert 100 < np.isfinite(depth).sum() < 5000


def test_the_visible_share_is_the_same_in_c(caster: PartCaster, heap: Heap) -> None:
    poses = heap(12)
    share = caster.visible_fraction(poses, Camera(), None)
    with native.disabled():
        np.testing.assert_array_equal(share, caster.visible_fraction(poses, Camera(), None))
    assert share.min() < 0.9 < share.max()
