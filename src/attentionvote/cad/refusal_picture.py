"""A picture of what is wrong with a part's file, for its owner: the surface, and on it the places."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection  # type: ignore[import-untyped]
from numpy.typing import NDArray

VIEWS = ((25, -60, "from above"), (-25, 120, "from below, behind"))
MOST_FACES = 15_000
MOST_LINES = 5_000


def write_refusal(triangles: NDArray[np.float64], where: NDArray[np.float64], title: str, path: Path) -> None:
    """Write a PNG of ``triangles`` ``(F, 3, 3)`` with the lines ``where`` ``(N, 2, 3)`` in red, all in metres."""
    figure = Figure(figsize=(11, 5.5), layout="constrained")
    FigureCanvasAgg(figure)
    rng = np.random.default_rng(0)
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    half = float(np.linalg.norm(high - low)) * 500
    middle = (low + high) * 500
    shown = triangles[rng.permutation(len(triangles))[:MOST_FACES]] * 1000
    lines = where[rng.permutation(len(where))[:MOST_LINES]] * 1000
    for i, (elevation, azimuth, name) in enumerate(VIEWS):
        axes = figure.add_subplot(1, 2, i + 1, projection="3d")
        axes.add_collection3d(Poly3DCollection(shown, facecolors=(0.7, 0.78, 0.9, 0.35), edgecolors="none"))
        axes.add_collection3d(Line3DCollection(lines, colors="red", linewidths=2.5))
        # Short lines would not be seen on a large part.
        axes.plot(*lines.mean(axis=1).T, linestyle="none", marker="o", markersize=5, color="red", alpha=0.5)
        axes.set(**{f"{k}lim": (m - half, m + half) for k, m in zip("xyz", middle, strict=True)})
        axes.set_title(f"{name}, mm")
        axes.set_box_aspect((1, 1, 1), zoom=1.2)
        axes.view_init(elevation, azimuth)
    figure.suptitle(title, wrap=True)
    figure.savefig(path, dpi=100, format="png")
