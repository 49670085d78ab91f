"""Cameras from files as people have them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.simulation.camera import Camera
from attentionvote.simulation.camera_file import read_camera

CAMERA = Camera(640, 480, 600.0, 610.0, 319.5, 241.25)
MATRIX = [600.0, 0, 319.5, 0, 610.0, 241.25, 0, 0, 1]
SIZE = {"width": 640, "height": 480}
WAYS = {
    "figures": {"fx": 600, "fy": 610, "cx": 319.5, "cy": 241.25, **SIZE},
    "bop": {"cam_K": MATRIX, "depth_scale": 0.1, **SIZE},
    "rows": {"K": [MATRIX[:3], MATRIX[3:6], MATRIX[6:]], **SIZE},
    "ros2": {"header": {"frame_id": "x"}, "k": MATRIX, "d": [0, 0, 0, 0, 0], **SIZE},
    "by_image": {"0": {"cam_K": MATRIX, **SIZE}, "1": {"cam_K": MATRIX, **SIZE}},
    "cell": {"camera": {"fx": 600, "fy": 610, "cx": 319.5, "cy": 241.25, **SIZE}, "bin": {"size": [1, 1, 1]}},
}


def written(tmp_path: Path, content: object) -> Path:
    path = tmp_path / "camera.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.mark.parametrize("way", WAYS)
def test_every_way_of_writing_means_the_same_camera(tmp_path: Path, way: str) -> None:
    assert read_camera(written(tmp_path, WAYS[way])) == CAMERA


def test_a_calibration_of_ros(tmp_path: Path) -> None:
    text = "image_width: 640\nimage_height: 480\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [600.0, 0, 319.5, 0, "
    assert read_camera(written(tmp_path, text + "610.0, 241.25, 0, 0, 1]\n")) == CAMERA


@given(st.lists(st.floats(1, 5000), min_size=4, max_size=4))
def test_figures_survive(tmp_path_factory: pytest.TempPathFactory, figures: list[float]) -> None:
    fx, fy, cx, cy = figures
    path = written(tmp_path_factory.mktemp("c"), {"K": [fx, 0, cx, 0, fy, cy, 0, 0, 1], **SIZE})
    assert read_camera(path) == Camera(640, 480, fx, fy, cx, cy)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            {"fx": 1, "fy": 1, "cx": 1, **SIZE},
            "must have fx, fy, cx, cy or a matrix cam_K, K, k, camera_matrix, got no cy",
        ),
        ({"K": [1, 2, 3], **SIZE}, "K must be row by row fx 0 cx 0 fy cy 0 0 1, got"),
        ({"K": [1, 0.5, 1, 0, 1, 1, 0, 0, 1], **SIZE}, "K must be row by row"),
        ({"K": ["a"] * 9, **SIZE}, "K must be numbers"),
        ({"cam_K": MATRIX}, "must have width, whole pixels, got None: add it, e.g. 639"),
        ({"cam_K": MATRIX, "width": 640.5, "height": 480}, "must have width, whole pixels, got 640.5"),
        ({"cam_K": [-1.0, *MATRIX[1:]], **SIZE}, "fx must be greater than 0"),
        ("[1, 2", "must be JSON or YAML"),
        ("3", "got no names at all"),
    ],
)
def test_what_is_no_camera_is_one_sentence(tmp_path: Path, content: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_camera(written(tmp_path, content))


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"camera file '.*none\.json' does not exist"):
        read_camera(tmp_path / "none.json")


def test_the_projection_matrix_of_a_rectified_picture_counts(tmp_path: Path) -> None:
    # As `ros2 topic echo` prints a message, with the distortion that K is of, and an end of document.
    path = tmp_path / "info.yaml"
    path.write_text(
        "width: 640\nheight: 480\nd: [0.1, 0, 0, 0, 0]\nk: [600, 0, 320, 0, 600, 240, 0, 0, 1]\n"
        "p: [520, 0, 318, 0, 0, 521, 238, 0, 0, 0, 1, 0]\n---\n"
    )
    assert read_camera(path) == Camera(640, 480, 520, 521, 318, 238)
    path.write_text(path.read_text().replace("520, 0, 318, 0, 0, 521, 238", "0, 0, 0, 0, 0, 0, 0"))
    assert read_camera(path) == Camera(640, 480, 600, 600, 320, 240)
    path.write_text("binning_x: 2\n" + path.read_text())
    with pytest.raises(ValueError, match="must be of the whole picture, got binning_x 2"):
        read_camera(path)
