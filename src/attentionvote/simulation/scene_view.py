"""Pictures of a scene for people: an interactive 3D page and three images."""

from __future__ import annotations

import colorsys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attentionvote.files import whole
from attentionvote.geometry.pose import apply
from attentionvote.part import Parts
from attentionvote.scene import Scene
from attentionvote.simulation.bin_walls import bin_outlines
from attentionvote.simulation.raycast import PartCaster
from attentionvote.simulation.scene_record import SceneRecord

_GOLDEN_RATIO = 0.618033988749895


def instance_colours(count: int) -> NDArray[np.float64]:
    """``(count, 3)`` RGB in 0..1; neighbouring indices differ much."""
    return np.array(
        [
            colorsys.hsv_to_rgb((i * _GOLDEN_RATIO) % 1, 0.75 - 0.25 * (i % 2), 0.95 - 0.2 * (i % 3))
            for i in range(count)
        ]
    ).reshape(-1, 3)


def scene_figure(part: Parts, record: SceneRecord, scene: Scene, max_shown: int = 20000) -> Any:
    """Plotly figure of a scene in the camera frame (metres): points by instance, posed meshes, bin, part axes.

    Args:
        part: the part, or the set of parts in the bin.
        record: where the parts are.
        scene: what the sensor saw of it.
        max_shown: most points shown; a browser is slow beyond.
    """
    import plotly.graph_objects as go

    colours = [f"rgb({r},{g},{b})" for r, g, b in (instance_colours(len(record.camera_from_part)) * 255).astype(int)]
    points, ids = scene.points[:max_shown], scene.instance_ids[:max_shown]
    several = len(part.parts) > 1
    names = [f"{part.parts[kind].title or part.parts[kind].name}, " if several else "" for kind in record.part_ids]
    figure = go.Figure()
    figure.add_trace(
        go.Scatter3d(
            **_columns(points),
            mode="markers",
            marker={"size": 1.6, "color": [colours[i] for i in ids]},
            text=[f"{names[i]}instance {i}, visible {record.visible_fraction[i]:.0%}" for i in ids],
            hoverinfo="text",
            name=f"points ({len(points):,} of {len(scene.points):,})",
        )
    )
    kinds = [part.parts[kind] for kind in record.part_ids]
    posed = [apply(pose, kind.vertices) for pose, kind in zip(record.camera_from_part, kinds, strict=True)]
    first = np.cumsum([0, *(len(placed) for placed in posed)])
    vertices = np.concatenate(posed)
    faces = np.concatenate([kind.faces + start for kind, start in zip(kinds, first, strict=False)])
    figure.add_trace(
        go.Mesh3d(
            **_columns(np.round(vertices, 5)),
            i=faces[:, 0],
            j=faces[:, 1],
            k=faces[:, 2],
            facecolor=np.repeat(colours, [len(kind.faces) for kind in kinds]),
            flatshading=True,
            hoverinfo="skip",
            showlegend=True,
            visible="legendonly",
            name="true parts (click)",
        )
    )
    figure.add_trace(_lines("bin", [*_bin_edges(record)], "#888888"))
    length = 0.25 * part.diameter
    for axis, colour in enumerate(("#d62728", "#2ca02c", "#1f77b4")):
        tips = [(pose[:3, 3], pose[:3, 3] + length * pose[:3, axis]) for pose in record.camera_from_part]
        figure.add_trace(_lines(f"part {'xyz'[axis]} axes", tips, colour))
    figure.update_layout(
        title=f"{part.title or part.name}: {record.drop_count} parts, cycle {record.cycle}",
        legend={"itemsizing": "constant"},
        scene={
            "aspectmode": "data",
            "xaxis_title": "x (m)",
            "yaxis_title": "y (m)",
            "zaxis_title": "z (m), away from the camera",
            # As the camera sees it: looking along z, y down.
            "camera": {"up": {"x": 0, "y": -1, "z": 0}, "eye": {"x": 0, "y": 0.5, "z": -1.6}},
        },
        margin={"l": 0, "r": 0, "t": 40, "b": 0},
    )
    return figure


def write_view(directory: Path, part: Parts, caster: PartCaster, record: SceneRecord, scene: Scene) -> dict[str, Path]:
    """Write ``scene.html`` (self-contained), ``depth.png``, ``instances.png``, ``visibility.png``; their paths.

    The depth is the noise-free one of every pixel, bin included.
    """
    directory.mkdir(parents=True, exist_ok=True)
    camera = record.camera
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    rays = camera.rays(np.stack([u.ravel(), v.ravel()], axis=1))
    hits = caster.cast(record.camera_from_part, rays, record.bin_surface, record.part_ids)
    depth = np.where(np.isfinite(hits.depth), hits.depth, np.nan).reshape(v.shape)
    colours = instance_colours(len(record.camera_from_part))
    owner = hits.instance.reshape(v.shape)
    background = np.full((*v.shape, 3), 0.93)
    # A little shading by the normal tells the faces apart.
    shade = (0.45 - 0.55 * hits.normal[:, 2].reshape(*v.shape, 1)).clip(0, 1)
    instances = np.where(owner[..., None] >= 0, colours[owner] * shade, background)
    visible = np.where(owner >= 0, record.visible_fraction[owner], np.nan)
    files: dict[str, Callable[[Path], object]] = {
        "scene.html": lambda path: scene_figure(part, record, scene).write_html(path, include_plotlyjs="inline"),
        "depth.png": lambda path: _image(path, depth, "depth z (m)", "viridis_r"),
        "instances.png": lambda path: _image(path, instances, "instances"),
        "visibility.png": lambda path: _image(path, visible, "visible share of each part", "RdYlGn", record),
    }
    for name, write in files.items():
        whole(directory / name, write)
    return {name: directory / name for name in files}


def _image(path: Path, pixels: NDArray, title: str, colours: str = "", record: SceneRecord | None = None) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 7), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    limits = {"vmin": 0, "vmax": 1} if record is not None else {}
    shown = axes.imshow(pixels, cmap=colours or None, interpolation="nearest", **limits)  # type: ignore[arg-type]
    if colours:
        figure.colorbar(shown, ax=axes, shrink=0.8)
    if record is not None:
        for centre, share in zip(record.camera_from_part[:, :3, 3], record.visible_fraction, strict=True):
            u, v = record.camera.project(centre)
            if 0 <= u < record.camera.width and 0 <= v < record.camera.height:
                box = {"facecolor": "white", "alpha": 0.6, "edgecolor": "none", "pad": 1}
                axes.text(u, v, f"{share:.2f}", fontsize=7, ha="center", va="center", bbox=box)
    axes.set_title(title)
    axes.set_xlabel("u (pixel)")
    axes.set_ylabel("v (pixel)")
    figure.savefig(path, dpi=110, format="png")


def _columns(points: NDArray) -> dict[str, NDArray]:
    return {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2]}


def _lines(name: str, segments: list[tuple[NDArray, NDArray]], colour: str) -> Any:
    import plotly.graph_objects as go

    gap = np.full(3, np.nan)
    path = np.array([p for a, b in segments for p in (a, b, gap)]).reshape(-1, 3)
    return go.Scatter3d(**_columns(path), mode="lines", line={"color": colour, "width": 3}, hoverinfo="skip", name=name)


def _bin_edges(record: SceneRecord) -> list[tuple[NDArray, NDArray]]:
    if record.walls is not None:  # its rings: floor, opening, rim, underside
        rings = [apply(record.camera_from_bin, ring) for ring in bin_outlines(record.bin_size, record.walls)]
        return [(ring[i - 1], ring[i]) for ring in rings for i in range(len(ring))]
    x, y, z = record.bin_size * (0.5, 0.5, 1.0)
    corners = np.array([[sx * x, sy * y, h] for h in (0.0, z) for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    c = apply(record.camera_from_bin, corners)
    pairs = [(i, (i + 1) % 4) for i in range(4)]
    return [(c[a + d], c[b + d]) for d in (0, 4) for a, b in pairs] + [(c[i], c[i + 4]) for i in range(4)]
