"""A picture of a part for its owner: three shaded views with the frame and the symmetry axis."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D  # type: ignore[import-untyped]
from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

from attentionvote.cad.symmetry_detection import describe
from attentionvote.part import Part

VIEWS = ((25, -60, "from above"), (-25, 120, "from below, behind"), (0, 0, "along x"))
MOST_FACES = 30_000
LIGHT = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])


def write_picture(part: Part, path: Path) -> None:
    """Write a PNG of ``part``: x red, y green, z blue from its origin, the symmetry axis black and dashed."""
    figure = Figure(figsize=(13.5, 5), layout="constrained")
    FigureCanvasAgg(figure)
    triangles = part.vertices[part.faces]
    if len(triangles) > MOST_FACES:  # drawing more takes minutes and shows nothing more
        triangles = triangles[np.random.default_rng(0).permutation(len(triangles))[:MOST_FACES]]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    shade = 0.35 + 0.6 * np.clip(0.5 + 0.5 * (normals / np.where(length > 0, length, 1.0)) @ LIGHT, 0, 1)
    colours = np.stack([0.75 * shade, 0.85 * shade, shade, np.full_like(shade, 0.75)], axis=-1)
    for i, (elevation, azimuth, name) in enumerate(VIEWS):
        axes = figure.add_subplot(1, 3, i + 1, projection="3d")
        axes.add_collection3d(Poly3DCollection(triangles * 1000, facecolors=colours))
        _draw_frame(axes, part)
        middle, half = (part.vertices.min(0) + part.vertices.max(0)) * 500, part.diameter * 550
        axes.set(**{f"{k}lim": (m - half, m + half) for k, m in zip("xyz", middle, strict=True)})
        axes.set_title(name)
        axes.set_axis_off()
        axes.set_box_aspect((1, 1, 1), zoom=1.3)
        axes.view_init(elevation, azimuth)
    size = " x ".join(f"{e * 1000:.1f}" for e in part.vertices.max(0) - part.vertices.min(0))
    symmetry = describe(part.symmetry)
    figure.suptitle(f"{part.title or part.name}: {size} mm, D {part.diameter * 1000:.2f} mm, symmetry {symmetry}")
    figure.savefig(path, dpi=100, format="png")


def _draw_frame(axes: Axes3D, part: Part) -> None:
    reach = part.diameter * 0.6 * 1000
    for unit, colour, name in zip(np.eye(3), ("tab:red", "tab:green", "tab:blue"), "xyz", strict=True):
        axes.plot(*np.stack([np.zeros(3), unit * reach]).T, color=colour, linewidth=2)
        axes.text(*(unit * reach * 1.05), name, color=colour)
    if part.symmetry.kind in ("cyclic", "dihedral", "revolution"):
        u = np.asarray(part.symmetry.axis) * reach * 1.15
        axes.plot(*np.stack([-u, u]).T, color="black", linestyle="--", linewidth=1.5)
