"""Convex pieces of a part for the physics: coacd once per part, then from a disk cache."""

from __future__ import annotations

import hashlib
import logging
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attentionvote.files import cache_folder, whole
from attentionvote.part import Part

log = logging.getLogger(__name__)

Hulls = tuple[NDArray[np.float64], ...]


def convex_hulls(part: Part, threshold: float = 0.1, max_vertices: int = 64, cache: Path | None = None) -> Hulls:
    """Vertices of the convex pieces whose union approximates ``part``, part frame, metres.

    Args:
        part: the part; its surface is the cache key, with both settings and coacd's version.
        threshold: coacd's concavity threshold. 0.1 gives 8-10 pieces, and piles no worse than 0.02 does.
        max_vertices: most vertices of one piece.
        cache: cache directory, default ``files.cache_folder``.

    Returns:
        One ``(V, 3)`` float64 array per piece, a few seconds the first time, then read from the cache.

    Raises:
        ValueError: when a setting is out of range, or coacd finds no piece with a volume.

    Reference: Wei et al., "Approximate convex decomposition with collision-aware concavity", SIGGRAPH 2022.
    """
    if not 0.01 <= threshold <= 1:
        raise ValueError(f"hull threshold must lie in 0.01..1 (coacd's range), got {threshold}")
    if not 8 <= max_vertices <= 256:
        raise ValueError(f"hull vertices must lie in 8..256, got {max_vertices}")
    path = hull_file(part, threshold, max_vertices, cache or cache_folder())
    if path.is_file():
        with np.load(path) as stored:
            return tuple(stored[f"hull_{i:03d}"] for i in range(len(stored.files)))
    log.info("%s: splitting the surface into convex pieces (once per part, some seconds)", part.name)
    hulls = _decompose(part, threshold, max_vertices)
    pieces: dict[str, Any] = {f"hull_{i:03d}": hull for i, hull in enumerate(hulls)}
    whole(path, lambda temporary: np.savez(temporary, **pieces))
    return hulls


def hull_file(part: Part, threshold: float, max_vertices: int, cache: Path) -> Path:
    """Where a cache keeps the pieces of a part: ``hull_000`` and so on in an ``.npz`` file."""
    h = hashlib.sha256(np.round(part.vertices * 1e9).astype(np.int64).tobytes() + part.faces.tobytes())
    h.update(repr((threshold, max_vertices, version("coacd"))).encode())
    return cache / "hulls" / f"{h.hexdigest()[:32]}.npz"


def _decompose(part: Part, threshold: float, max_vertices: int) -> Hulls:
    # Imported here: it loads a large native library that readers of the cache do not need.
    import coacd
    from scipy.spatial import ConvexHull, QhullError

    coacd.set_log_level("off")
    # In units of D, so that the result does not depend on the part's size.
    mesh = coacd.Mesh(part.vertices / part.diameter, part.faces)
    pieces = coacd.run_coacd(mesh, threshold=threshold, max_ch_vertex=max_vertices, seed=0)
    hulls = []
    for vertices, _ in pieces:
        scaled = np.asarray(vertices, dtype=np.float64)
        try:
            hull = ConvexHull(scaled)
        except QhullError:
            continue  # a flat sliver carries no contact that its neighbours do not
        if hull.volume > 1e-9:
            hulls.append(scaled[hull.vertices] * part.diameter)
    if not hulls:
        raise ValueError(f"{part.name}: the surface must enclose a volume, but its convex decomposition has none")
    return tuple(hulls)
