"""Cells: defaults that exist in the world and work, and sentences where the user's choice does not."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.part import Part
from attentionvote.section import read
from attentionvote.simulation.bin_walls import Walls
from attentionvote.simulation.camera import Camera
from attentionvote.simulation.cell import CellSettings, fitting_distance
from attentionvote.simulation.cell_choice import BINS, choose_cell, parsed_bin, walls_for
from attentionvote.simulation.cell_text import cell_text
from attentionvote.simulation.sensor_models import SENSOR_MODELS


def ring(diameter: float) -> Part:
    mesh = trimesh.creation.annulus(0.25 * diameter, 0.5 * diameter, 0.1 * diameter)
    return Part("ring", np.array(mesh.vertices), np.array(mesh.faces), diameter)


@given(st.floats(0.002, 0.38))
def test_a_default_cell_sees_all_of_a_bin_with_room_for_the_pile(diameter: float) -> None:
    cell = choose_cell(ring(diameter), 30)
    model = SENSOR_MODELS[cell.sensor]
    size = np.array(cell.bin.size)
    assert model.near < cell.distance < model.far
    assert cell.distance >= fitting_distance(cell.camera, cell.bin.size, cell.bin.walls) - 1e-9
    # The bin's rim and floor lie in the sensor's range, and within the picture.
    assert cell.distance - size[2] * 2 / 3 >= model.near - 1e-9
    assert cell.distance + size[2] / 3 <= model.far + 1e-9
    rim = (cell.bin.walls.outer_size(size) / 2) / (cell.distance - size[2] * 2 / 3)
    assert (rim * (cell.camera.fx, cell.camera.fy) < (cell.camera.width / 2, cell.camera.height / 2)).all()
    # 30 parts are a heap: the protocol's floor is 4.93 D^2.
    heap = cell.bin.size[:2] if cell.area is None else cell.area
    assert 0.75 * 4.93 * diameter**2 < np.prod(heap) < 1.3 * 4.93 * diameter**2
    assert (np.array(heap) <= size[:2]).all()
    assert tuple(side * 1000 for side in cell.bin.size) in [pytest.approx(entry[1]) for entry in BINS]


def test_a_washer_gets_a_small_scanner_at_its_own_distance() -> None:
    cell = choose_cell(ring(0.012), 30)
    assert (cell.sensor, cell.distance, cell.bin.size) == ("phoxi_s", 0.44, (0.08, 0.06, 0.03))
    assert cell.measures is not None
    assert (cell.measures.preset, cell.measures.scaled) == ("phoxi", False)


def test_what_the_user_says_holds() -> None:
    cell = choose_cell(ring(0.012), 30, "phoxi_m", "360x280x160", 800)
    assert (cell.sensor, cell.distance, cell.bin.size) == ("phoxi_m", 0.8, (0.36, 0.28, 0.16))
    assert cell.area == pytest.approx((0.36 * 12 / 143, 0.28 * 12 / 143), abs=1e-4)
    assert cell.camera == SENSOR_MODELS["phoxi_m"].camera
    # The distance alone leads to a sensor that measures there.
    assert choose_cell(ring(0.012), 30, distance_mm=800).sensor == "phoxi_m"
    assert choose_cell(ring(0.012), 30, distance_mm=1200).sensor == "phoxi_l"
    assert choose_cell(ring(0.143), 30).area is None


def test_a_camera_of_the_users(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({"fx": 1000, "fy": 1000, "cx": 500, "cy": 400, "width": 1000, "height": 800}))
    cell = choose_cell(ring(0.05), 30, camera_file=path)
    assert (cell.sensor, cell.camera, cell.measures) == (
        "custom",
        Camera(1000, 800, 1000.0, 1000.0, 500.0, 400.0),
        None,
    )
    assert choose_cell(ring(0.05), 30, "custom", distance_mm=2500, camera_file=path).distance == 2.5
    with pytest.raises(ValueError, match=r"sensor must be custom with camera=.*, got phoxi_s: leave one of them out"):
        choose_cell(ring(0.05), 30, "phoxi_s", camera_file=path)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            {"sensor": "phoxi_s", "distance_mm": 800},
            "distance must lie within 384..520 mm, the range of phoxi_s, got 800",
        ),
        ({"sensor": "phoxi_m", "distance_mm": 100}, "got 100: take 458"),
        (
            {"sensor": "phoxi_s", "bin_text": "360x280x160"},
            "bin must be in the picture of phoxi_s, which holds 360x280x160 mm from 646 mm on but measures up to 520 "
            "mm only: take phoxi_m or phoxi_l or",
        ),
        (
            {"sensor": "phoxi_m", "bin_text": "360x280x160", "distance_mm": 500},
            r"distance must be at least 591 mm, from where on the picture of phoxi_m holds .*; got 500",
        ),
        ({"bin_text": "36"}, "bin must be inner length x width x height in mm, e.g. 360x280x160; got '36'"),
        ({"bin_text": "0.36x0.28x0.16"}, "bin must be millimetres, every side 10 to 3000"),
        ({"bin_text": "10x10x10"}, "bin must hold a heap of 6 parts of 50 mm, got 10x10x10: take e.g. bin=130x100x60"),
        ({"sensor": "custom"}, "camera must name a file with sensor=custom"),
        ({"sensor": "phoxy"}, "sensor must be one of phoxi_s, phoxi_m"),
        ({"distance_mm": 3000}, "none of the usual scanners sees a bin of 180x130x60 mm at distance=3000"),
    ],
)
def test_an_impossible_choice_is_one_sentence(words: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        choose_cell(ring(0.05), 30, **words)


def test_a_part_for_which_no_bin_is_usual() -> None:
    with pytest.raises(ValueError, match=r"bin must be given for a part of 700 mm, .* e\.g\. bin=1762x1371x783"):
        choose_cell(ring(0.7), 30)


@pytest.mark.parametrize("words", [{}, {"sensor": "realsense_d435"}, {"bin_text": "360x280x160"}])
def test_the_text_of_a_cell_is_the_cell(words: dict) -> None:
    cell = choose_cell(ring(0.02), 30, **words)
    text = cell_text(cell)
    assert read(CellSettings, yaml.safe_load(text)["cell"], "cell") == cell
    assert SENSOR_MODELS[cell.sensor].sheet in " ".join(text.replace("#", "").split())
    assert max(map(len, text.splitlines())) <= 130


def test_bins_in_millimetres() -> None:
    assert parsed_bin("360x280x160") == (0.36, 0.28, 0.16)
    assert parsed_bin(" 80.5 X 60 * 30") == (0.0805, 0.06, 0.03)
    for _, size, walls in BINS:
        assert asdict(walls_for(tuple(side / 1000 for side in size)))["thickness"] == walls.thickness  # type: ignore[arg-type]
    assert walls_for((0.01, 0.01, 0.01)).problem(np.array([0.01, 0.01, 0.01])) == ""
    assert fitting_distance(Camera(), (0.36, 0.28, 0.16), Walls()) > 0.6


def test_a_low_bin_gets_more_floor_or_is_refused() -> None:
    block = trimesh.creation.box([0.04, 0.02, 0.01])
    part = Part("block", np.array(block.vertices), np.array(block.faces), 0.0458)
    high, low = (choose_cell(part, 30, bin_text=f"600x400x{height}") for height in (160, 20))
    assert high.area is not None
    # The same heap in a lower bin covers as much more floor, as far as there is any.
    wider = np.prod(low.area or low.bin.size[:2]) / np.prod(high.area)
    assert wider == pytest.approx(0.05124 / 0.02, rel=0.02)  # the protocol's bin of this part is 51 mm high
    cube = trimesh.creation.box([0.06, 0.06, 0.06])
    with pytest.raises(ValueError, match="high enough for parts that lie on each other, at least 90 mm, got 80"):
        choose_cell(Part("cube", np.array(cube.vertices), np.array(cube.faces), 0.104), 30, bin_text="600x400x80")


def test_a_principal_point_beside_the_middle_needs_more_distance() -> None:
    size, walls = (0.36, 0.28, 0.16), Walls()
    middle = fitting_distance(Camera(640, 480, 600, 600, 319.5, 239.5), size, walls)
    beside = fitting_distance(Camera(640, 480, 600, 600, 479.5, 239.5), size, walls)
    half = walls.outer_size(np.array(size))[0] / 2
    assert beside == pytest.approx(half * 600 / 160 * 1.05 + 0.16 * 2 / 3, rel=1e-3)
    assert beside > 1.5 * middle
