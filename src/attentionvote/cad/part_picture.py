"""A picture of a part for its owner: three shaded views with the frame and the symmetry axis."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from attentionvote.cad.surface_distance import SurfaceDistance
from attentionvote.cad.symmetry_groups import describe
from attentionvote.part import Part

Array = NDArray[np.float64]

VIEWS = ((25, -60, "from above"), (-25, 120, "from below, behind"), (0, 0, "along x"))  # elevation, azimuth, degrees
PIXELS = 640
CREASE = 0.94  # cosine between the normals of neighbouring pixels below which a line is drawn: 20 degrees
STEP = 0.01  # of the picture's width, of depth between neighbouring pixels beyond what the slope explains: a line
LIGHT = np.array([-0.35, 0.55, 0.75]) / np.linalg.norm([-0.35, 0.55, 0.75])  # from the left, above and the viewer
MARGIN = 1.15


def write_picture(part: Part, path: Path) -> None:
    """Write a PNG of ``part``: x red, y green, z blue from its origin, the symmetry axis black and dashed.

    Every pixel is a ray, so that a part of a million triangles is drawn as fast as a box, and a sheet hides what is
    behind it.
    """
    figure = Figure(figsize=(13.5, 5), layout="constrained")
    FigureCanvasAgg(figure)
    surface = SurfaceDistance(part.vertices, part.faces)
    middle = part.box.mean(axis=0)
    for i, (elevation, azimuth, name) in enumerate(VIEWS):
        view_from_part = _view(np.radians(elevation), np.radians(azimuth))
        corners = (part.vertices - middle) @ view_from_part.T
        half = MARGIN * float(np.abs(corners[:, :2]).max())
        axes = figure.add_subplot(1, 3, i + 1)
        axes.imshow(_shaded(surface, middle, view_from_part, half), extent=(-half, half, -half, half))
        _draw_frame(axes, part, middle, view_from_part, half)
        axes.set(title=name, xlim=(-half, half), ylim=(-half, half))
        axes.set_axis_off()
    size = " x ".join(f"{e * 1000:.1f}" for e in np.ptp(part.box, axis=0))
    symmetry = describe(part.symmetry)
    figure.suptitle(f"{part.title or part.name}: {size} mm, D {part.diameter * 1000:.2f} mm, symmetry {symmetry}")
    figure.savefig(path, dpi=100, format="png")


def _view(elevation: float, azimuth: float) -> Array:
    """``view_from_part`` ``(3, 3)``: x right, y up, z towards the viewer, who stands in that direction; z is up."""
    out = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return np.stack([right, np.cross(out, right), out])


def _shaded(surface: SurfaceDistance, middle: Array, view_from_part: Array, half: float) -> Array:
    """``(PIXELS, PIXELS, 4)`` colours: the surface lit, with lines along creases and outlines; clear beside it."""
    grid = (np.arange(PIXELS) + 0.5) / PIXELS * 2 * half - half
    x, y = np.meshgrid(grid, grid[::-1])
    # Far enough to be outside of the part whatever its depth along this view.
    far = 4 * half + 2 * surface.size
    start = np.stack([x, y, np.full_like(x, far)], axis=-1) @ view_from_part + middle
    depth, normal = surface.cast(start.reshape(-1, 3), -view_from_part[2])
    depth = depth.reshape(PIXELS, PIXELS)
    normal = normal.reshape(PIXELS, PIXELS, 3) @ view_from_part.T
    normal = normal * np.where(normal[..., 2:] < 0, -1.0, 1.0)
    hit = np.isfinite(depth)
    line = np.zeros_like(hit)
    width = 2 * half / PIXELS
    for axis in (0, 1):
        near, next_ = (np.take(hit, np.arange(PIXELS - 1) + k, axis) for k in (0, 1))
        both = near & next_
        first, second = (np.take(normal, np.arange(PIXELS - 1) + k, axis) for k in (0, 1))
        crease = np.einsum("uvi,uvi->uv", first, second) < CREASE
        slope = np.minimum(first[..., 2], second[..., 2])
        deep = np.where(both, np.diff(np.where(hit, depth, 0.0), axis=axis), 0.0)
        step = np.abs(deep) > STEP * 2 * half + 3 * width / np.maximum(slope, 0.05)
        edge = (both & (crease | step)) | (near ^ next_)
        rows = (slice(None, -1), slice(None)) if axis == 0 else (slice(None), slice(None, -1))
        line[rows] |= edge
    shade = 0.35 + 0.6 * np.clip(0.3 + 0.7 * normal @ LIGHT, 0, 1)
    picture = np.stack([0.75 * shade, 0.85 * shade, shade, hit.astype(float)], axis=-1)
    picture[line] = (0.1, 0.12, 0.15, 1.0)
    return picture


def _draw_frame(axes: Axes, part: Part, middle: Array, view_from_part: Array, half: float) -> None:
    reach = 0.55 * half
    origin = (view_from_part @ -middle)[:2]
    for unit, colour, name in zip(np.eye(3), ("tab:red", "tab:green", "tab:blue"), "xyz", strict=True):
        end = origin + (view_from_part @ unit)[:2] * reach
        axes.plot(*np.stack([origin, end]).T, color=colour, linewidth=2)
        x, y = origin + 1.08 * (end - origin)
        axes.text(x, y, name, color=colour, clip_on=True)
    if part.symmetry.kind in ("cyclic", "dihedral", "revolution"):
        u = (view_from_part @ np.asarray(part.symmetry.axis))[:2] * half * 1.05
        axes.plot(*np.stack([origin - u, origin + u]).T, color="black", linestyle="--", linewidth=1.5)
