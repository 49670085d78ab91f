"""The cell file: strict keys with the nearest valid one, and every impossible value in one sentence."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.inference.cell import parse_cell, read_cell
from attentionvote.inference.errors import InputError

CAMERA = {"fx": 1000.0, "fy": 1001.0, "cx": 640.0, "cy": 512, "depth_scale": 0.0001, "missing": 65535, "width": 1296}
POSE = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.85], [0, 0, 0, 1]]
BIN = {"camera_from_bin": POSE, "size": [0.36, 0.28, 0.16], "margin": 0.004}


def described(**content: Any) -> bytes:
    """The content of a cell file."""
    return json.dumps(content).encode()


def test_a_cell_has_its_camera_and_its_bin(tmp_path: Path) -> None:
    (tmp_path / "cell.json").write_bytes(described(camera=CAMERA, bin=BIN))
    cell = read_cell(tmp_path / "cell.json")
    assert cell.camera is not None
    assert cell.crop is not None
    assert {name: getattr(cell.camera, name) for name in CAMERA} == CAMERA
    assert (cell.camera.depth_offset, cell.camera.height) == (0.0, None)
    np.testing.assert_array_equal(cell.crop.camera_from_bin, POSE)
    np.testing.assert_array_equal(cell.crop.size, BIN["size"])
    assert cell.crop.margin == 0.004


def test_both_parts_are_optional() -> None:
    empty = parse_cell(b"{}")
    assert (empty.camera, empty.crop) == (None, None)
    assert parse_cell(described(camera=CAMERA)).crop is None
    cropped = parse_cell(described(bin={"camera_from_bin": POSE, "size": [0.3, 0.2, 0.1]}))
    assert cropped.crop is not None
    assert cropped.crop.margin == 0.002


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "it must be JSON"),
        (b"{", "it must be JSON"),
        (b"\xff", "it must be JSON"),
        (b"[" * 60_000, "it must be JSON"),
        (b"[]", "the cell must be a JSON object with camera, bin, cloud, got list"),
        (described(camra={}), "the cell must have the keys camera, bin, cloud; got 'camra', did you mean 'camera'?"),
        (described(camera=[]), "camera must be a JSON object with fx, fy, .*, got list"),
        (described(camera=CAMERA | {"depthscale": 1}), "got 'depthscale', did you mean 'depth_scale'?"),
        (described(camera={"fx": 1}), "camera must have fy, but it is missing"),
        (described(camera=CAMERA | {"fx": 0}), "camera fx must be positive, got 0"),
        (described(camera=CAMERA | {"fx": "1000"}), "camera fx must be a finite number, got '1000'"),
        (described(camera=CAMERA | {"cx": None}), "camera cx must be a finite number, got None"),
        (described(camera=CAMERA | {"cx": True}), "camera cx must be a finite number, got True"),
        (b'{"camera": {"fx": NaN, "fy": 1, "cx": 1, "cy": 1}}', "camera fx must be a finite number, got nan"),
        (b'{"camera": {"fx": 1e999, "fy": 1, "cx": 1, "cy": 1}}', "camera fx must be a finite number, got inf"),
        (described(camera=CAMERA | {"depth_offset": -1}), "depth_offset must be 0 to 20 metres, got -1"),
        (described(camera=CAMERA | {"missing": 1.5}), "camera missing must be a whole number of at least 0, got 1.5"),
        (described(camera=CAMERA | {"missing": None}), "camera missing must be a whole number of at least 0, got None"),
        (described(camera=CAMERA | {"width": 0}), "camera width must be a whole number of at least 1, got 0"),
        (
            described(camera=CAMERA | {"fx": 12.0}),
            "camera fx must be at least 56.69 pixels, got 12: are these the lens",
        ),
        (
            described(camera=CAMERA | {"fx": 60_000}),
            "camera fx must be at most 4.95e+04 pixels, got 60000: are these mic",
        ),
        (
            described(camera=CAMERA | {"fy": 16}),
            "camera fy must be at least 20 pixels, got 16: are these the lens's mill",
        ),
        (
            described(camera=CAMERA | {"fy": 480}),
            "camera fx and fy must be alike, within a factor of 2, got 1000 and 480",
        ),
        (
            described(camera=CAMERA | {"cx": 2593}),
            "camera cx must lie between -1296 and 2592 pixels, got 2593: is it of",
        ),
        (described(camera=CAMERA | {"cy": -1e6}), "camera cy must lie between -100000 and 100000 pixels, got -1e+06"),
        (
            described(camera=CAMERA | {"depth_scale": 1}),
            "depth_scale must be 1e-06 to 0.1 metres per count, got 1: for",
        ),
        (described(camera=CAMERA | {"depth_scale": 1e-7}), "must be 1e-06 to 0.1 metres per count, got 1e-07"),
        (
            described(camera=CAMERA | {"depth_offset": 500}),
            "depth_offset must be 0 to 20 metres, got 500: are these mi",
        ),
        (b'{"camera": {"fx": 1, "cx": 2, "fx": 3}}', "each key must stand once in its object, got 'fx' twice: remove"),
        (b'{"bin": {}, "bin": {}}', "each key must stand once in its object, got 'bin' twice"),
        (described(cloud="mm"), "cloud must be a JSON object with unit, got str"),
        (described(cloud={}), "cloud must have unit, but it is missing"),
        (
            described(cloud={"unit": "MM"}),
            "cloud unit must be one of m, cm, mm, um, inch, got 'MM', did you mean 'mm'?",
        ),
        (described(cloud={"unit": 1}), "cloud unit must be one of m, cm, mm, um, inch, got '1'"),
        (described(cloud={"unit": ["m"]}), "cloud unit must be one of"),
        (described(cloud={"units": "m"}), "cloud must have the keys unit; got 'units', did you mean 'unit'?"),
        (described(bin={"size": [1, 1, 1]}), "bin must have camera_from_bin, but it is missing"),
        (described(bin=BIN | {"bin_size": 1}), "got 'bin_size', did you mean 'size'?"),
        (described(bin=BIN | {"size": {}}), "bin size must be .* numbers, got something else"),
        (described(bin=BIN | {"size": [360, 280, 160]}), "are these millimetres"),
    ],
)
def test_an_impossible_cell_is_one_sentence(content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "cell.json"
    path.write_bytes(content)
    with pytest.raises(
        InputError, match=f"^cell file {path}: .*{message}".replace("?", r"\?").replace("e+0", r"e\+0")
    ) as caught:
        read_cell(path)
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize(
    ("unit", "value", "metres"),
    [("m", 0.8, 0.8), ("cm", 80, 0.8), ("mm", 800, 0.8), ("um", 8e5, 0.8), ("inch", 100, 2.54)],
)
def test_clouds_of_a_unit_become_metres(unit: str, value: float, metres: float) -> None:
    cell = parse_cell(described(cloud={"unit": unit}))
    points = np.full((70_000, 3), value, np.float32)
    points[1] = np.nan
    expected = np.full((70_000, 3), metres, np.float32)
    expected[1] = np.nan
    for shape in ((70_000, 3), (700, 100, 3)):
        np.testing.assert_array_equal(cell.cloud.metres(points.reshape(shape)), expected.reshape(shape), strict=True)
    assert points[0, 0] == np.float32(value)  # the caller's array is not changed
    assert parse_cell(b"{}").cloud.unit == "m"


def test_a_missing_or_huge_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read: No such file"):
        read_cell(tmp_path / "none.json")
    with pytest.raises(InputError, match="cannot be read: Is a directory"):
        read_cell(tmp_path)
    (tmp_path / "huge").write_bytes(b" " * 100_000)
    with pytest.raises(InputError, match="at most 65536 bytes"):
        read_cell(tmp_path / "huge")


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(["camera", "bin", "cloud", "unit", *CAMERA, *BIN, "other"]), inner, max_size=6
        )
    ),
    max_leaves=20,
)


@given(st.dictionaries(st.sampled_from(["camera", "bin", "cloud"]), JSON, max_size=3))
def test_no_content_raises_anything_else(content: dict[str, Any]) -> None:
    try:
        parse_cell(described(**content))
    except InputError as error:
        assert str(error)  # noqa: PT017
