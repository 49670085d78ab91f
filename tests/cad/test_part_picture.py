"""The picture of a part: what it shows, at any number of triangles."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from attentionvote.cad.part_picture import write_picture
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.part import Part


def drawn(mesh: trimesh.Trimesh, path: Path, symmetry: Symmetry | None = None) -> np.ndarray:
    part = Part("thing", np.array(mesh.vertices), np.array(mesh.faces), 0.1, symmetry or Symmetry())
    write_picture(part, path)
    return np.asarray(Image.open(path).convert("RGB"), dtype=float) / 255


def blue(picture: np.ndarray) -> np.ndarray:
    """Pixels of the surface."""
    return (picture[..., 2] > picture[..., 0] + 0.05) & (picture[..., 2] > picture[..., 1] + 0.02)


def test_the_picture_does_not_depend_on_the_triangles(tmp_path: Path) -> None:
    box = trimesh.creation.box([0.1, 0.06, 0.03])
    fine = box.copy()
    for _ in range(6):
        fine = fine.subdivide()
    assert len(fine.faces) > 40_000
    coarse_picture = drawn(box, tmp_path / "coarse.png")
    start = time.process_time()
    fine_picture = drawn(fine, tmp_path / "fine.png")
    assert time.process_time() - start < 10
    assert np.abs(coarse_picture - fine_picture).mean() < 0.002
    assert blue(coarse_picture).mean() > 0.1


def test_a_sheet_with_a_hole_shows_the_hole(tmp_path: Path) -> None:
    sheet = trimesh.creation.box([0.1, 0.1, 0.001])
    holed = trimesh.boolean.difference([sheet, trimesh.creation.cylinder(0.03, 0.01)])
    closed, opened = blue(drawn(sheet, tmp_path / "a.png")), blue(drawn(holed, tmp_path / "b.png"))
    lost = (closed & ~opened).sum() / closed.sum()
    assert 0.15 < lost < 0.35  # pi .03^2 / .1^2 is 28 %, less what the third view has


def test_the_symmetry_axis_is_drawn(tmp_path: Path) -> None:
    bar = trimesh.creation.cylinder(0.01, 0.08, sections=32)
    plain = drawn(bar, tmp_path / "a.png")
    marked = drawn(bar, tmp_path / "b.png", Symmetry("revolution", flip=True))
    dark = [(p[60:].max(axis=-1) < 0.2).sum() for p in (plain, marked)]
    assert dark[1] > dark[0] + 500
