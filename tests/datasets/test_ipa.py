"""The IPA layout: written and read back, against formulas written down independently, and what is refused."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from attentionvote.datasets import open_datasets
from attentionvote.datasets.depth_image import PinholeCamera
from attentionvote.datasets.ipa import IpaDataset, read_ground_truth, read_parameters
from attentionvote.datasets.ipa_writer import IpaWriter
from attentionvote.geometry.pose import matrix_from_quaternion, random_quaternion, transform

COUNTS = (0, 3, 6)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, make_pile: Callable[..., Any]) -> Path:
    """``training/Box`` with one cycle of 0, 3 and 6 boxes in a bin."""
    folder = tmp_path_factory.mktemp("ipa") / "training" / "Box"
    piles = [make_pile(count) for count in COUNTS]
    writer = IpaWriter(folder, "box", piles[0].pinhole, 0.5, 1.1)
    for pile in piles:
        writer.write(7, *pile[1:3], *pile[4:])
    return folder


def test_a_written_scene_is_read_back(written: Path, make_pile: Callable[..., Any]) -> None:
    (dataset,) = open_datasets(written.parent.parent)
    assert (dataset.format, dataset.title, dataset.split, dataset.parts) == ("ipa", "Box", "train", ("Box",))
    assert dataset.names == ("cycle_0007/000", "cycle_0007/003", "cycle_0007/006")
    assert [dataset.drop_count(name) for name in dataset.names] == list(COUNTS)
    assert dataset.scored_names == ("cycle_0007/006",)
    assert dataset.missing_files() == {"depth": [], "gt": [], "labels": []}
    pile = make_pile(6)
    frame = dataset.frame("cycle_0007/006")
    seen = np.isfinite(pile.depth)
    np.testing.assert_array_equal(np.isfinite(frame.depth), seen)
    half_a_count = (1.1 - 0.5) / 65535 / 2
    assert np.abs(frame.depth - pile.depth)[seen].max() <= half_a_count * 1.0001
    np.testing.assert_array_equal(frame.instance, pile.instance)
    assert frame.unknown_pixels == 0
    truth = frame.ground_truth
    np.testing.assert_allclose(truth.camera_from_part, pile.camera_from_part, atol=1e-12)
    np.testing.assert_allclose(truth.visible_fraction, pile.visible_fraction, atol=1e-12)
    np.testing.assert_allclose(truth.occlusion_rate, 1 - pile.visible_fraction, atol=1e-12)


def test_a_scene_holds_the_exact_points_of_the_parts_and_not_the_bin(
    written: Path, make_pile: Callable[..., Any]
) -> None:
    pile, (dataset,) = make_pile(6), open_datasets(written)
    scene = dataset.scene("cycle_0007/006")
    parts = pile.instance >= 0
    assert len(scene.points) == parts.sum()
    for row in range(6):
        exact = pile.exact_points[pile.instance == row]
        read = scene.points[scene.instance_ids == row]
        assert len(read) == len(exact)
        # Half a count of depth is 4.6 micrometres; the order of the scene is random.
        distance = np.linalg.norm(read[:, None] - exact[None], axis=-1)
        assert max(distance.min(axis=1).max(), distance.min(axis=0).max()) < 6e-6
    everything = dataset.scene("cycle_0007/006", remove_background=False)
    assert len(everything.points) == np.isfinite(pile.depth).sum()
    assert (everything.instance_ids == -1).sum() == np.isfinite(pile.depth).sum() - parts.sum()
    np.testing.assert_array_equal(dataset.scene("cycle_0007/006").points, scene.points)
    assert not np.array_equal(np.sort(scene.points[:, 1]), scene.points[:, 1])
    assert len(dataset.scene("cycle_0007/000").points) == 0


def test_the_point_of_a_pixel_is_the_formula_of_the_format(written: Path) -> None:
    # Reference section 0, fact 4, in the dataset's own frame, then half a turn about z.
    said = json.loads((written / "parameter.json").read_text())
    dataset = IpaDataset([written])
    frame = dataset.frame("cycle_0007/003")
    points, pixels = frame.camera.points(frame.depth)
    counts = np.asarray(Image.open(written / "p_depth" / "cycle_0007" / "003_depth_uint16.png")).astype(float)
    z = said["clip_start"] + counts / 65535 * (said["clip_end"] - said["clip_start"])
    v, u = np.mgrid[0 : z.shape[0], 0 : z.shape[1]]
    big = said["resolution_big"]
    f = big / (2 * np.tan(np.radians(said["perspectiveAngle"]) / 2))
    x = -(u + said["pixelOffset_X_KoSyTopLeft"] + 0.5 - big / 2) * z / f
    y = -(v + said["pixelOffset_Y_KoSyTopLeft"] + 0.5 - big / 2) * z / f
    expected = np.stack([-x, -y, z], axis=-1).reshape(-1, 3)[pixels]
    np.testing.assert_allclose(points, expected, atol=1e-7)
    assert said["pixelOffset_X_KoSyTopLeft"] + z.shape[1] <= big
    assert min(said["pixelOffset_X_KoSyTopLeft"], said["pixelOffset_Y_KoSyTopLeft"]) >= 0
    # The same camera with other numbers: half a pixel counts.
    np.testing.assert_allclose([frame.camera.cx, frame.camera.cy, frame.camera.fx], [57.0, 50.0, 200.0], atol=1e-9)


def test_rotations_are_column_by_column_and_the_first_row_is_the_bin(tmp_path: Path) -> None:
    r = matrix_from_quaternion([0.3, -0.5, 0.7, 0.2])
    header = "id,class,x,y,z," + ",".join(f"rot_{a}_axis_{i}" for a in "xyz" for i in (1, 2, 3))
    header += ",visibility_score_o,visibility_score_p"
    columns = [r[0, 0], r[1, 0], r[2, 0], r[0, 1], r[1, 1], r[2, 1], r[0, 2], r[1, 2], r[2, 2]]
    lines = [header, "0,bin,0,0,1,1,0,0,0,1,0,0,0,1,1,1"]
    lines += [f"{i},part,0.1,0.2,0.9,{','.join(map(str, columns))},0.1,{v}" for i, v in ((1, 1.2), (2, 0.25))]
    path = tmp_path / "002.csv"
    path.write_text("\n".join(lines) + "\n")
    truth = read_ground_truth(path)
    half_turn = np.diag([-1.0, -1.0, 1.0])
    np.testing.assert_allclose(truth.camera_from_part[0, :3, :3], half_turn @ r, atol=1e-12)
    np.testing.assert_allclose(truth.camera_from_part[0, :3, 3], [-0.1, -0.2, 0.9])
    np.testing.assert_allclose(truth.visible_fraction, [1.0, 0.25])  # above 1 is cut
    np.testing.assert_array_equal(truth.label_ids, [1, 2])
    path.write_text("")
    assert len(read_ground_truth(path).camera_from_part) == 0


@settings(max_examples=25, deadline=None)
@given(
    size=st.tuples(st.integers(8, 3000), st.integers(8, 3000)),
    principal=st.tuples(st.integers(-50, 3000), st.integers(-50, 3000)),
    half=st.sampled_from([0.0, 0.5]),
    focal=st.floats(100, 10_000),
    seed=st.integers(0, 10**6),
)
def test_any_camera_and_pose_survives(
    tmp_path_factory: pytest.TempPathFactory, size: Any, principal: Any, half: float, focal: float, seed: int
) -> None:
    folder = tmp_path_factory.mktemp("any") / "Box"
    camera = PinholeCamera(*size, focal, focal, principal[0] + half, principal[1] + half)
    IpaWriter(folder, "box", camera, 0.4, 2.0)
    read = read_parameters(folder / "parameter.json").camera
    assert (read.width, read.height) == size
    np.testing.assert_allclose([read.fx, read.fy, read.cx, read.cy], [focal, focal, camera.cx, camera.cy], rtol=1e-9)
    rng = np.random.default_rng(seed)
    poses = transform(matrix_from_quaternion(random_quaternion(rng, (4,))), rng.uniform((-1, -1, 1), 3, (4, 3)))
    small = PinholeCamera(8, 8, 10.0, 10.0, 3.5, 3.5)
    nothing = np.full((8, 8), np.nan), np.full((8, 8), -1)
    writer = IpaWriter(folder, "box", small, 0.4, 2.0)
    writer.write(0, *nothing, poses, rng.random(4), np.eye(4))
    truth = read_ground_truth(folder / "gt" / "cycle_0000" / "004.csv")
    np.testing.assert_allclose(truth.camera_from_part, poses, atol=1e-12)


@pytest.mark.parametrize(
    ("line", "change", "message"),
    [
        (1, {"id": "1"}, r"the first row must be the bin, id 0, got id 1"),
        (2, {"id": "2"}, r"ids of parts must be different whole numbers above 0, got \[2, 2"),
        (2, {"z": "850"}, r"the translation of entry 0 must be in metres, got .*looks like millimetres"),
        (2, {"rot_x_axis_1": "5"}, r"R of entry 0 must be a rotation .*, got a deviation of"),
        (2, {"x": "nan"}, "poses must be finite"),
        (2, {"y": "abc"}, "every row must have 16 values, numbers in the named columns"),
        (2, {"visibility_score_p": "-0.5"}, "visibility_score_p must be at least 0, got -0.5"),
        (0, {"rot_z_axis_2": "r23"}, "the first line must name the column rot_z_axis_2, got id, class"),
    ],
)
def test_what_breaks_a_rule_of_the_table_is_one_sentence(
    written: Path, tmp_path: Path, line: int, change: dict[str, str], message: str
) -> None:
    rows = list(csv.reader((written / "gt" / "cycle_0007" / "003.csv").read_text().splitlines()))
    for key, value in change.items():
        rows[line][rows[0].index(key)] = value
    path = tmp_path / "003.csv"
    path.write_text("\n".join(map(",".join, rows)))
    with pytest.raises(ValueError, match=message) as caught:
        read_ground_truth(path)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"clip_start": 500, "clip_end": 1100}, "must be in metres, got 500.0 and 1100.0: looks like millimetres"),
        ({"clip_end": 0.4}, "metres with 0 <= clip_start < clip_end"),
        ({"perspectiveAngle": 0.6}, "perspectiveAngle must be degrees .* got 0.6: is it in radians"),
        ({"resolutionX": 0}, "camera width must be positive, got 0"),
        ({"resolution_big": "big"}, "resolution_big must be a finite number, got 'big'"),
    ],
)
def test_what_breaks_a_rule_of_the_parameters_is_one_sentence(
    written: Path, tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    path = tmp_path / "parameter.json"
    path.write_text(json.dumps(json.loads((written / "parameter.json").read_text()) | change))
    with pytest.raises(ValueError, match=message):
        read_parameters(path)


def test_real_pictures_are_a_dataset_of_their_own(written: Path, tmp_path: Path) -> None:
    folder = tmp_path / "testing" / "IPARingScrew"
    real = folder / "p_depth_real_world" / "cycle_0000"
    real.mkdir(parents=True)
    (folder / "parameter.json").write_text((written / "parameter.json").read_text())
    empty = np.asarray(Image.open(written / "p_depth" / "cycle_0007" / "000_depth_uint16.png")).copy()
    for count in (0, 5):
        noisy = empty.astype(np.int64)
        noisy[(noisy > 0) & (noisy < 65535)] += 300 if count else 0  # 2.7 mm: the bin, in a real picture
        if count:
            noisy[20:30, 20:40] = 20000
        Image.fromarray(noisy.astype(np.uint16)).save(real / f"{count:03d}_depth_uint16.png")
    (dataset,) = open_datasets(tmp_path)
    assert (dataset.split, dataset.parts, dataset.has_labels) == ("real", ("ring_screw",), False)
    assert dataset.names == ("cycle_0000/000", "cycle_0000/005")
    assert dataset.missing_files() == {"depth": [], "gt": list(dataset.names)}
    frame = dataset.frame("cycle_0000/005", labels=False)
    assert (frame.background_tolerance, frame.nearest) == (0.005, 1.26)
    with pytest.raises(ValueError, match="scene cycle_0000/005 has no file of its gt"):
        dataset.scene("cycle_0000/005")
    assert len(dataset.points("cycle_0000/005")) == 0  # everything here is nearer than 1.26 m, where no part is
    box = IpaDataset([folder], real=True)
    box.__dict__["benchmark"] = None
    assert len(box.points("cycle_0000/005")) == 200


def test_the_parts_of_an_object_are_one_dataset(written: Path, tmp_path: Path) -> None:
    for number, cycle in ((1, "cycle_0000"), (2, "cycle_0250")):
        folder = tmp_path / "training" / f"SileaneBunny_part_{number}"
        for place in ("gt", "p_depth", "p_segmentation"):
            (folder / place).mkdir(parents=True)
            (folder / place / cycle).symlink_to(written / place / "cycle_0007")
        (folder / "parameter.json").symlink_to(written / "parameter.json")
    (dataset,) = open_datasets(tmp_path)
    assert (dataset.title, dataset.parts, dataset.diameters) == ("SileaneBunny", ("bunny",), (0.234,))
    assert dataset.names[0] == "cycle_0000/000"
    assert dataset.names[-1] == "cycle_0250/006"
    assert len(dataset.scene("cycle_0250/006").points) > 100
    (folder / "gt" / "cycle_0000").symlink_to(written / "gt" / "cycle_0007")
    with pytest.raises(ValueError, match=r"cycle_0000 must be in one part of the object, got it in .*part_1 and .*"):
        open_datasets(tmp_path)


def test_the_writer_refuses_what_the_layout_cannot_say(tmp_path: Path, make_pile: Callable[..., Any]) -> None:
    with pytest.raises(ValueError, match=r"one focal length, got fx 200\.0 and fy 210\.0"):
        IpaWriter(tmp_path, "box", PinholeCamera(20, 20, 200.0, 210.0, 10.0, 10.0), 0.5, 1.0)
    for cx, cy in ((10.0, 10.5), (10.2, 10.2)):
        with pytest.raises(ValueError, match="cx and cy both at whole or both at half pixels"):
            IpaWriter(tmp_path, "box", PinholeCamera(20, 20, 200.0, 200.0, cx, cy), 0.5, 1.0)
    assert not list(tmp_path.iterdir())
    pile = make_pile(2)
    writer = IpaWriter(tmp_path, "box", pile.pinhole, 0.5, 0.8)
    with pytest.raises(ValueError, match=r"depth must lie in 0.5..0.8 m to be written, got 0\.\d+ m"):
        writer.write(0, *pile[1:3], *pile[4:])
    with pytest.raises(ValueError, match="at most 254 parts, got 255"):
        writer.write(0, *pile[1:3], np.tile(np.eye(4), (255, 1, 1)), np.ones(255), np.eye(4))
    with pytest.raises(ValueError, match="depth image must have the camera's 120 x 96 pixels, got 96 x 120"):
        writer.write(0, pile.depth.T, *pile[2:3], *pile[4:])
    assert [p.name for p in tmp_path.iterdir()] == ["parameter.json"]


def test_pictures_that_are_none_of_depth_are_refused(written: Path, tmp_path: Path) -> None:
    folder = tmp_path / "Box"
    for place in ("gt", "p_depth", "p_segmentation"):
        (folder / place / "cycle_0007").mkdir(parents=True)
        for path in (written / place / "cycle_0007").iterdir():
            (folder / place / "cycle_0007" / path.name).write_bytes(path.read_bytes())
    (folder / "parameter.json").write_bytes((written / "parameter.json").read_bytes())
    depth = folder / "p_depth" / "cycle_0007" / "003_depth_uint16.png"
    whole = depth.read_bytes()
    for content, message in (
        (np.zeros((96, 120), np.uint8), "a depth image must be 16-bit grey, got mode L"),
        (np.zeros((120, 96), np.uint16), "must have the camera's 120 x 96 pixels, got 96 x 120"),
        (whole[: len(whole) // 2], "the image cannot be decoded"),
    ):
        if isinstance(content, bytes):
            depth.write_bytes(content)
        else:
            Image.fromarray(content).save(depth)
        with pytest.raises(ValueError, match=message):
            IpaDataset([folder]).scene("cycle_0007/003")
    depth.unlink()
    dataset = IpaDataset([folder])
    assert dataset.missing_files()["depth"] == ["cycle_0007/003"]
    with pytest.raises(ValueError, match="cycle_0007/003 has no file of its depth"):
        dataset.scene("cycle_0007/003")
    with pytest.raises(ValueError, match=r"no scene 'cycle_0001/003', the names go from 'cycle_0007/000'"):
        dataset.scene("cycle_0001/003")
