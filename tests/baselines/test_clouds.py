"""Thinning of clouds with normals."""

from __future__ import annotations

import numpy as np
import pytest

from attentionvote.baselines.clouds import thinned


def test_thinning_keeps_one_point_a_voxel_and_the_two_sides_of_a_wall_apart() -> None:
    rng = np.random.default_rng(3)
    place = rng.uniform(0, 0.1, (4000, 2))
    wall = [np.c_[place, np.full(4000, z), np.tile([0, 0, sign], (4000, 1))] for z, sign in ((0.0, -1), (0.001, 1))]
    thin = thinned(np.concatenate(wall).astype(np.float32), 0.01)
    assert len(thin) == 200  # 10 x 10 voxels of 10 mm, two sides
    np.testing.assert_allclose(thin[:, 5] * (thin[:, 2] - 0.0005), 0.0005, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(thin[:, 3:], axis=1), 1, atol=1e-6)
    assert np.ptp(thin[:, 0]) == pytest.approx(0.09, abs=0.004)
