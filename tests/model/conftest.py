"""Fixtures of the network tests: the C library, clouds, a small network with random weights."""

from __future__ import annotations

import ctypes
import shutil
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from tiny_network import tiny_network, with_random_norms
from torch import Tensor

from attentionvote.geometry import native
from attentionvote.model.network import AttentionVote


@pytest.fixture(scope="session")
def kernels() -> dict[str, ctypes.CDLL]:
    """The compiled kernels by file; without them the tests would compare the references with themselves."""
    if shutil.which("cc") is None:
        pytest.skip("no C compiler on this machine")
    found = {}
    for file in ("pooled_mlp.c", "network_ops.c"):
        library = native.load("attentionvote.model", file, tuned=True)
        assert library is not None
        found[file] = library
    return found


def small_network(seed: int = 0, **changes: Any) -> AttentionVote:
    """A few thousand random weights, in evaluation with norms that are not the identity."""
    return with_random_norms(tiny_network(seed, **changes))


def random_cloud(seed: int, samples: int = 1, count: int = 96) -> tuple[Tensor, Tensor]:
    """Points ``(samples, count, 3)`` of a decimetre cube half a metre away and unit normals, on a 2^-12 m lattice."""
    rng = np.random.default_rng(seed)
    points = rng.integers(-205, 205, (samples, count, 3)) * 2.0**-12 + np.array([0, 0, 0.5])
    normals = rng.normal(size=(samples, count, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return torch.from_numpy(points.astype(np.float32)), torch.from_numpy(normals.astype(np.float32))


# Functions as fixtures of the session: test modules cannot import each other, and hypothesis wants no other scope.
@pytest.fixture(scope="session")
def make_network() -> Callable[..., AttentionVote]:
    return small_network


@pytest.fixture(scope="session")
def make_cloud() -> Callable[..., tuple[Tensor, Tensor]]:
    return random_cloud
