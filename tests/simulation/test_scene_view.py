"""Pictures of a scene."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.image import imread

from attentionvote.part import Part
from attentionvote.simulation.raycast import PartCaster
from attentionvote.simulation.scene_record import SceneRecord
from attentionvote.simulation.scene_view import instance_colours, scene_figure, write_view
from attentionvote.simulation.sensor import Sensor, synthesize


def test_colours_of_neighbours_differ() -> None:
    colours = instance_colours(40)
    assert colours.shape == (40, 3)
    assert ((colours >= 0) & (colours <= 1)).all()
    assert np.abs(np.diff(colours, axis=0)).max(axis=1).min() > 0.2
    assert instance_colours(0).shape == (0, 3)


def test_the_figure_shows_points_parts_bin_and_axes(
    bracket: Part, caster: PartCaster, scene_record: Callable[..., SceneRecord]
) -> None:
    record = scene_record(4)
    scene = synthesize(record, caster, Sensor(), 3000, np.random.default_rng(0))
    points, parts, walls, *axes = scene_figure(bracket, record, scene, max_shown=1000).data
    assert len(points.x) == len(points.marker.color) == 1000
    assert len(set(points.marker.color)) == len(np.unique(scene.instance_ids[:1000]))
    assert (len(parts.x), len(parts.i)) == (4 * len(bracket.vertices), 4 * len(bracket.faces))
    assert parts.visible == "legendonly"
    assert len(walls.x) == 12 * 3
    assert [len(a.x) for a in axes] == [4 * 3] * 3
    # The page is in the camera frame: an axis starts where its part is.
    np.testing.assert_allclose([axes[0].x[0], axes[0].y[0], axes[0].z[0]], record.camera_from_part[0, :3, 3])


def test_the_files_are_complete_and_self_contained(
    bracket: Part, caster: PartCaster, scene_record: Callable[..., SceneRecord], tmp_path: Path
) -> None:
    record = scene_record(4)
    scene = synthesize(record, caster, Sensor("phoxi"), 500, np.random.default_rng(0))
    files = write_view(tmp_path / "view", bracket, caster, record, scene)
    assert sorted(p.name for p in (tmp_path / "view").iterdir()) == sorted(files)
    page = files["scene.html"].read_text()
    assert "Plotly.newPlot" in page
    assert 'src="http' not in page
    for name in ("depth.png", "instances.png", "visibility.png"):
        picture = imread(files[name])
        assert picture.shape[0] > 500
        assert picture[..., :3].std() > 0.05
