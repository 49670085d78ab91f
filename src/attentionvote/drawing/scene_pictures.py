"""Pictures of a scene: votes, their heat with the peaks, and the poses found, each in two orthographic views."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike, NDArray

from attentionvote.drawing.figures import new_figure

Array = NDArray[np.float64]
View = Literal["camera", "side"]

CORRECT, WRONG, TRUTH = "#0A8F3C", "#D62728", "#8A8A8A"
# Columns of a camera-frame point drawn to the right, drawn downwards, and the viewing direction (OpenCV: y down,
# z away from the camera). From the side the camera is above: z points down.
VIEWS: dict[View, tuple[int, int, Array]] = {
    "camera": (0, 1, np.array([0.0, 0.0, 1.0])),
    "side": (0, 2, np.array([0.0, -1.0, 0.0])),
}
SHARP_COSINE = float(np.cos(np.radians(35)))


class Wireframe:
    """The lines by which a draughtsman would draw a mesh: visible sharp edges and the outline.

    Args:
        vertices: (V, 3) metres, part frame.
        faces: (F, 3) vertex indices.
    """

    def __init__(self, vertices: ArrayLike, faces: ArrayLike) -> None:
        self.vertices = np.asarray(vertices, dtype=np.float64)
        faces = np.asarray(faces, dtype=np.int64)
        a, b, c = (self.vertices[faces[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        self.normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        # Edges twice, once for each face; sorted, so that the two faces of an edge follow each other.
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        owner = np.tile(np.arange(len(faces)), 3)
        order = np.lexsort((edges[:, 1], edges[:, 0]))
        edges, owner = edges[order], owner[order]
        pair = np.flatnonzero((edges[1:] == edges[:-1]).all(axis=1))
        self.edges = edges[pair]
        self.edge_faces = np.stack([owner[pair], owner[pair + 1]], axis=1)
        cosine = (self.normals[self.edge_faces[:, 0]] * self.normals[self.edge_faces[:, 1]]).sum(axis=1)
        self.is_sharp = cosine < SHARP_COSINE

    def segments(self, camera_from_part: ArrayLike, view: View) -> Array:
        """(S, 2, 2) metres: the drawn lines of the mesh at a pose, as (right, down) of the view."""
        right, down, direction = VIEWS[view]
        pose = np.asarray(camera_from_part, dtype=np.float64)
        faces_us = self.normals @ pose[:3, :3].T @ direction < 0
        first, second = faces_us[self.edge_faces].T
        drawn = (first != second) | (self.is_sharp & (first | second))
        corners = self.vertices @ pose[:3, :3].T + pose[:3, 3]
        return corners[self.edges[drawn]][:, :, [right, down]]


def _view_axes(axes: Axes, title: str, view: View, points: Array) -> None:
    right, down, _ = VIEWS[view]
    if title:
        axes.set_title(title, loc="left", fontsize=14, fontweight="bold")
    axes.set_aspect("equal", adjustable="box")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_color("0.85")
    axes.set_ylabel("from the camera" if view == "camera" else "from the side", fontsize=12, color="0.4")
    if len(points):
        low, high = np.percentile(points, 0.2, axis=0), np.percentile(points, 99.8, axis=0)
        margin = 0.06 * float((high - low).max()) + 1e-6
        axes.set_xlim(low[right] - margin, high[right] + margin)
        axes.set_ylim(high[down] + margin, low[down] - margin)
        scale = 10.0 ** np.floor(np.log10(max(float(high[right] - low[right]), 1e-6) / 2))
        x, y = low[right], high[down] + 0.5 * margin
        axes.plot([x, x + scale], [y, y], color="0.25", linewidth=2.5, solid_capstyle="butt")
        label = f"{1000 * scale:g} mm"
        axes.annotate(label, (x + scale, y), (5, 0), textcoords="offset points", va="center", fontsize=10, color="0.25")


def _cloud(axes: Axes, points: Array, view: View) -> None:
    right, down, direction = VIEWS[view]
    if not len(points):
        return
    depth = points @ direction
    order = np.argsort(-depth)  # what is near is painted over what is far
    near = 1 - (depth - depth.min()) / max(float(np.ptp(depth)), 1e-9)
    grey = np.repeat((0.88 - 0.28 * near)[:, None], 3, axis=1)
    axes.scatter(points[order, right], points[order, down], s=2.5, c=grey[order], linewidths=0, zorder=1)


def draw_votes(axes: Axes, points: Array, votes: Array, gt_centers: Array, view: View) -> None:
    """Points grey, votes by the colour of their nearest true centre, true centres as crosses."""
    right, down, _ = VIEWS[view]
    _cloud(axes, points, view)
    colours = np.full((len(votes), 3), 0.3)
    if len(gt_centers) and len(votes):
        nearest = np.linalg.norm(votes[:, None] - gt_centers[None], axis=2).argmin(axis=1)
        colours = _instance_colours(len(gt_centers))[nearest]
    axes.scatter(votes[:, right], votes[:, down], s=9, c=colours, linewidths=0, alpha=0.85, zorder=2)
    for width, colour in ((3.4, "white"), (1.6, "black")):
        axes.scatter(gt_centers[:, right], gt_centers[:, down], s=52, marker="x", c=colour, linewidths=width, zorder=3)


def _instance_colours(count: int) -> Array:
    from matplotlib.colors import hsv_to_rgb

    index = np.arange(count)
    # Steps of the golden ratio: neighbours in the list differ clearly.
    hue, value = (index * 0.61803) % 1, np.where(index % 2, 0.62, 0.88)
    return np.asarray(hsv_to_rgb(np.stack([hue, np.full(count, 0.85), value], axis=1)))


def draw_heat(axes: Axes, points: Array, votes: Array, heat: Array, peaks: Array, view: View) -> None:
    """Votes by their heat, hottest on top, and a ring at each peak."""
    right, down, _ = VIEWS[view]
    _cloud(axes, points, view)
    order = np.argsort(heat)
    drawn = axes.scatter(
        votes[order, right], votes[order, down], s=10, c=heat[order], cmap="inferno_r", linewidths=0, zorder=2
    )
    drawn.set_clim(0, max(1e-9, float(heat.max())) if len(heat) else 1)
    axes.scatter(
        peaks[:, right], peaks[:, down], s=110, facecolors="none", edgecolors="#0072B2", linewidths=1.8, zorder=3
    )
    if view == "camera":
        bar = axes.figure.colorbar(drawn, cax=axes.inset_axes((0.66, 0.075, 0.3, 0.022)), orientation="horizontal")
        bar.ax.tick_params(labelsize=9, length=2, color="0.25", labelcolor="0.25")
        bar.ax.set_title("heat", fontsize=10, color="0.25", pad=3)
        bar.ax.spines[:].set_visible(False)


def draw_poses(
    axes: Axes,
    points: Array,
    predicted: Sequence[tuple[Wireframe, Array]],
    correct: NDArray[np.bool_],
    truth: Sequence[tuple[Wireframe, Array]],
    view: View,
) -> None:
    """The mesh at every pose: truth grey, correct results green, wrong ones red on top."""
    _cloud(axes, points, view)
    groups = [
        (truth, TRUTH, 1.0, 0.55, 2),
        ([drawn for drawn, right in zip(predicted, correct, strict=True) if right], CORRECT, 1.1, 0.9, 3),
        ([drawn for drawn, right in zip(predicted, correct, strict=True) if not right], WRONG, 1.1, 0.9, 4),
    ]
    for drawn, colour, width, alpha, layer in groups:
        if drawn:
            lines = np.concatenate([wireframe.segments(pose, view) for wireframe, pose in drawn])
            axes.add_collection(LineCollection(list(lines), colors=colour, linewidths=width, alpha=alpha, zorder=layer))


def _with_meshes(meshes: Sequence[Wireframe], poses: Array, parts: ArrayLike | None) -> list[tuple[Wireframe, Array]]:
    kinds = np.zeros(len(poses), dtype=np.int64) if parts is None else np.asarray(parts, dtype=np.int64)
    if kinds.shape != (len(poses),):
        raise ValueError(f"parts must have one value for each of the {len(poses)} poses, got shape {kinds.shape}")
    return [(meshes[kind], pose) for kind, pose in zip(kinds, poses, strict=True)]


def scene_picture(
    points: ArrayLike,
    votes: ArrayLike,
    heat: ArrayLike,
    peaks: ArrayLike,
    gt_centers: ArrayLike,
    predicted_poses: ArrayLike,
    correct: ArrayLike,
    gt_poses: ArrayLike,
    vertices: Sequence[ArrayLike],
    faces: Sequence[ArrayLike],
    predicted_parts: ArrayLike | None = None,
    gt_parts: ArrayLike | None = None,
    title: str = "",
) -> Figure:
    """Votes, heat and poses of one scene, from the camera (x-y) and from the side (x-z). Lengths in metres.

    Args:
        points: (P, 3) camera frame.
        votes: (M, 3) camera frame.
        heat: (M,) of the votes.
        peaks: (K, 3) centres of the proposals.
        gt_centers: (I, 3) true centres.
        predicted_poses: (R, 4, 4) camera_from_part.
        correct: (R,) whether a result counts as correct.
        gt_poses: (I, 4, 4) camera_from_part.
        vertices: (V, 3) of every part's mesh.
        faces: (F, 3) of every part's mesh.
        predicted_parts: (R,) which part each result is; all are the first by default.
        gt_parts: (I,) the same of the truth.
        title: one line above.

    Raises:
        ValueError: shapes disagree. Anything but the mesh may be empty.
    """
    cloud, voted, peaked, centers = (
        np.asarray(a, dtype=np.float64).reshape(-1, 3) for a in (points, votes, peaks, gt_centers)
    )
    predicted_matrices, truth = (np.asarray(a, dtype=np.float64).reshape(-1, 4, 4) for a in (predicted_poses, gt_poses))
    hot, is_correct = np.asarray(heat, dtype=np.float64).ravel(), np.asarray(correct, dtype=bool).ravel()
    if len(hot) != len(voted):
        raise ValueError(f"heat must have one value for each of the {len(voted)} votes, got {len(hot)}")
    if len(is_correct) != len(predicted_matrices):
        raise ValueError(
            f"correct must have one value for each of the {len(predicted_matrices)} poses, got {len(is_correct)}"
        )
    meshes = [Wireframe(*mesh) for mesh in zip(vertices, faces, strict=True)]
    predicted, true = _with_meshes(meshes, predicted_matrices, predicted_parts), _with_meshes(meshes, truth, gt_parts)
    shown = cloud if len(cloud) else voted
    extent = np.ptp(shown, axis=0) if len(shown) else np.ones(3)
    ratio = np.clip(extent / max(float(extent[0]), 1e-6), 0.15, 1.6)
    heights = [float(ratio[1]), float(ratio[2])]
    figure = new_figure(1.0 + 5.2 * sum(heights))
    grid = figure.subplots(2, 3, height_ratios=heights)
    for row, view in enumerate(VIEWS):
        titles = ("Votes", "Heat", "Poses") if row == 0 else ("", "", "")
        draw_votes(grid[row, 0], cloud, voted, centers, view)
        draw_heat(grid[row, 1], cloud, voted, hot, peaked, view)
        draw_poses(grid[row, 2], cloud, predicted, is_correct, true, view)
        for axes, text in zip(grid[row], titles, strict=True):
            _view_axes(axes, text, view, shown)
        for axes in grid[row, 1:]:
            axes.set_ylabel("")
    right, wrong = int(is_correct.sum()), int((~is_correct).sum())
    cross = Line2D([], [], color="black", marker="x", linestyle="", label=f"{len(centers)} true centres")
    ring = Line2D([], [], color="#0072B2", marker="o", fillstyle="none", linestyle="", label=f"{len(peaked)} peaks")
    lines = [(CORRECT, f"{right} correct"), (WRONG, f"{wrong} wrong"), (TRUTH, f"{len(truth)} true")]
    handles = [Line2D([], [], color=colour, linewidth=2, label=label) for colour, label in lines]
    for axes, group in zip(grid[0], ([cross], [ring], handles), strict=True):
        axes.legend(
            handles=group,
            loc="lower right",
            bbox_to_anchor=(1, 1),
            ncols=3,
            fontsize=11,
            frameon=False,
            borderaxespad=0.2,
            handlelength=1.2,
            columnspacing=1.2,
        )
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontsize=15)
    return figure
