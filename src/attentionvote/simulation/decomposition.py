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
_FINEST = 0.01  # threshold that coacd goes down to

Hulls = tuple[NDArray[np.float64], ...]


def convex_hulls(
    part: Part,
    threshold: float = 0.1,
    max_vertices: int = 64,
    cache: Path | None = None,
    most_volume: float | None = None,
) -> Hulls:
    """Vertices of the convex pieces whose union approximates ``part``, part frame, metres.

    Args:
        part: the part; its surface is the cache key, with both settings and coacd's version.
        threshold: coacd's concavity threshold. 0.1 gives 8-10 pieces, and piles no worse than 0.02 does.
        max_vertices: most vertices of one piece.
        cache: cache directory, default ``files.cache_folder``.
        most_volume: of the pieces together, a multiple of the part's own; the threshold is halved until that holds,
            down to coacd's smallest. None takes the pieces as they come. The pieces of a thin ring of 131 mm have 2.0
            times its volume at a threshold of 0.1: such rings never interlock.

    Returns:
        One ``(V, 3)`` float64 array per piece, a few seconds the first time, then read from the cache.

    Raises:
        ValueError: when a setting is out of range, or coacd finds no piece with a volume.

    Reference: Wei et al., "Approximate convex decomposition with collision-aware concavity", SIGGRAPH 2022.
    """
    if not _FINEST <= threshold <= 1:
        raise ValueError(f"hull threshold must lie in 0.01..1 (coacd's range), got {threshold}")
    if not 8 <= max_vertices <= 256:
        raise ValueError(f"hull vertices must lie in 8..256, got {max_vertices}")
    cache = cache or cache_folder()
    hulls = _stored(part, threshold, max_vertices, cache)
    if most_volume is None:
        return hulls
    while (excess := volume_ratio(part, hulls)) > most_volume and threshold > _FINEST:
        threshold = max(threshold / 2, _FINEST)
        log.info(
            "%s: the convex pieces have %.2f times the part's volume, at most %g are asked for: finer, threshold %g",
            part.name, excess, most_volume, threshold,
        )  # fmt: skip
        hulls = _stored(part, threshold, max_vertices, cache)
    log.info("%s: %d convex pieces, %.2f times the part's volume", part.name, len(hulls), excess)
    return hulls


def volume_ratio(part: Part, hulls: Hulls) -> float:
    """Volume of the convex pieces together over that of the solid inside the part's surface."""
    from scipy.spatial import ConvexHull

    corners = part.vertices[part.faces] - part.vertices.mean(axis=0)
    solid = abs(float(np.linalg.det(corners).sum())) / 6
    return float(sum(ConvexHull(hull).volume for hull in hulls) / solid)


def _stored(part: Part, threshold: float, max_vertices: int, cache: Path) -> Hulls:
    """The pieces at one threshold, from the cache or for it."""
    path = hull_file(part, threshold, max_vertices, cache)
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
