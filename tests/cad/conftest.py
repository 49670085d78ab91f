"""Solids that the tests of part files share."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh


@pytest.fixture(scope="session")
def spur_gear() -> trimesh.Trimesh:
    """A gear of 24 teeth, radius 1, 0.1 high, 0.3 thick."""
    angle = np.arange(96) * 2 * np.pi / 96
    radius = np.where(np.arange(96) % 4 < 2, 1.0, 0.9)
    rim = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    rings = [np.column_stack([rim, np.full(96, z)]) for z in (0.0, 0.3)]
    i, j = np.arange(96), (np.arange(96) + 1) % 96
    sides = [np.stack([i, j, j + 96], 1), np.stack([i, j + 96, i + 96], 1)]
    ends = [np.stack([np.full(96, 192), j, i], 1), np.stack([np.full(96, 193), i + 96, j + 96], 1)]
    return trimesh.Trimesh(
        np.concatenate([*rings, [[0, 0, 0], [0, 0, 0.3]]]), np.concatenate(sides + ends), process=False
    )
