"""BOP's files: names, units and rows, and one sentence for each thing that is wrong."""

from __future__ import annotations

import json

import numpy as np
import pytest
from bop_split import HEADER, csv_row

from attentionvote.evaluation.bop_files import parse_name, read_estimates, read_targets, read_truth

TURN = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
ROW = csv_row(2, 30, 5, 0.25, TURN, [10, 20, 800], 1.5)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("ours_ipd-test.csv", ("ours", "ipd", "test")),
        ("ours-v2_xyzibd-test_1328490c-bf88-46ce-a12c-a5e5a7712220.csv", ("ours-v2", "xyzibd", "test")),
        ("ours_itoddmv-val-3dlong.csv", ("ours", "itoddmv", "val-3dlong")),
    ],
)
def test_a_name_says_method_data_set_and_split(name, expected):
    assert parse_name(f"some_folder/{name}") == expected


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("my_method_ipd-test.csv", r"got 'my_method_ipd-test\.csv', did you mean 'my-method_ipd-test\.csv'\?"),
        ("a_b_c_ipd-val_1.csv", r"did you mean 'a-b-c_ipd-val_1\.csv'\?"),
        ("results.csv", r"must be named METHOD_DATASET-SPLIT\[-TYPE\]\[_ID\]\.csv .*, got 'results\.csv'$"),
        ("ours_ipd.csv", "got 'ours_ipd.csv'$"),
        ("_ipd-test.csv", "got '_ipd-test.csv'$"),
    ],
)
def test_a_wrong_name_is_refused_with_the_nearest_right_one(name, text):
    with pytest.raises(ValueError, match=text):
        parse_name(name)


def test_rows_are_read_in_metres_and_by_rows_of_r(tmp_path):
    path = tmp_path / "a_b-c.csv"
    path.write_text(f"{HEADER}\n{ROW}\n\n{csv_row(1, 4, 7, -3, np.eye(3), [0, 0, 1], 0.5)}\n")
    poses, seconds = read_estimates(path)
    assert (poses.images.tolist(), poses.objects.tolist()) == ([[2, 30], [1, 4]], [5, 7])
    assert (poses.values.tolist(), seconds) == ([0.25, -3.0], 1.0)
    assert (poses.poses[0] @ [1, 0, 0, 1]).tolist() == [0.01, 1.02, 0.8, 1.0]
    path.write_text(HEADER)
    nothing, seconds = read_estimates(path)
    assert (nothing.poses.shape, nothing.images.shape, seconds) == ((0, 4, 4), (0, 2), None)
    path.write_text("\n".join([HEADER, ROW, csv_row(1, 4, 7, 1, np.eye(3), [0, 0, 1], -1)]))
    assert read_estimates(path)[1] is None


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("", f"the first line must be {HEADER}, got an empty file"),
        (ROW, f"the first line must be {HEADER}, got 2,30,5,0.25"),
        (HEADER.replace("im_id", "img_id"), "got scene_id,img_id"),
        (f"{HEADER}\n{ROW},", f"line 2 must have 7 values between commas, {HEADER}, got 8"),
        (f"{HEADER}\n{ROW}\n{ROW.replace('2,30', '2.0,30')}", r"line 3 must begin with three whole .*, got 2\.0,30,5"),
        (f"{HEADER}\n{ROW.replace('0.25', 'high')}", "line 2: score must be one finite number, got 'high'"),
        (f"{HEADER}\n{ROW.replace('0.25', 'nan')}", "line 2: score must be one finite number, got 'nan'"),
        (f"{HEADER}\n{ROW.replace('-1.0', '')}", "line 2: R must be 9 finite numbers between spaces, got"),
        (f"{HEADER}\n{ROW.replace('10.0', '10.0 10.0')}", "line 2: t must be 3 finite numbers between spaces, got"),
        (f"{HEADER}\n{ROW}\n{ROW.replace('-1.0', '1.0')}", "R of line 3 must be a rotation .* determinant -1"),
        (f"{HEADER}\n{ROW}\n{ROW.replace('1.5', '1.6')}", "time of line 3 must be .* scene 2, image 30, 1.5, got 1.6"),
    ],
)
def test_a_wrong_result_file_is_named_with_its_line(tmp_path, content, text):
    path = tmp_path / "a_b-c.csv"
    path.write_text(content)
    with pytest.raises(ValueError, match=text) as caught:
        read_estimates(path)
    assert str(caught.value).startswith(f"{path}: ")
    with pytest.raises(ValueError, match=r"the file cannot be read \(No such file or directory\)"):
        read_estimates(tmp_path / "none_b-c.csv")


def test_the_truth_of_every_image_is_read_in_metres(tmp_path):
    folder = tmp_path / "val" / "000012"
    folder.mkdir(parents=True)
    entry = {"obj_id": 5, "cam_R_m2c": np.ravel(TURN).tolist(), "cam_t_m2c": [10, 20, 800]}
    (folder / "scene_gt_photoneo.json").write_text(json.dumps({"7": [entry, entry], "3": []}))
    (folder / "scene_gt_info_photoneo.json").write_text(
        json.dumps({"7": [{"visib_fract": 0.25}, {"visib_fract": 1}], "3": []})
    )
    truth, images = read_truth(tmp_path / "val", "photoneo")
    assert images == [(12, 3), (12, 7)]
    assert (truth.images.tolist(), truth.objects.tolist()) == ([[12, 7]] * 2, [5, 5])
    assert truth.values.tolist() == [0.25, 1.0]
    assert (truth.poses[1] @ [1, 0, 0, 1]).tolist() == [0.01, 1.02, 0.8, 1.0]
    with pytest.raises(ValueError, match=r"with scene_gt\.json is needed, got none, but there is scene_gt_photoneo"):
        read_truth(tmp_path / "val")
    with pytest.raises(
        ValueError, match=r"nowhere: at least one folder NNNNNN with scene_gt\.json is needed, got none$"
    ):
        read_truth(tmp_path / "nowhere")


def change(path, edit) -> None:
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("file", "edit", "text"),
    [
        ("scene_gt", lambda c: c["0"][0].pop("cam_t_m2c"), "entry 0 of image 0 must have cam_t_m2c, got only obj_id"),
        ("scene_gt", lambda c: c["0"][1].update(cam_R_m2c=[1] * 9), "entry 1 of image 0: cam_R_m2c must be a rotation"),
        ("scene_gt", lambda c: c["4"][0].update(cam_t_m2c=[1]), r"cam_t_m2c must be 3 finite numbers, got \[1\]"),
        ("scene_gt", lambda c: c["4"].pop(), r"scene_gt_info\.json: image 4 must have 8 entries, .* got 9"),
        ("scene_gt_info", lambda c: c["4"][2].clear(), "entry 2 of image 4 must have visib_fract, got only nothing"),
        ("scene_gt", lambda c: c.update(a=[]), "the file must hold an object whose keys are numbers"),
    ],
)
def test_a_wrong_ground_truth_is_named(bop_split, file, edit, text):
    change(bop_split.gt / "000001" / f"{file}.json", edit)
    with pytest.raises(ValueError, match=text):
        read_truth(bop_split.gt)


def test_visibility_is_needed(bop_split):
    (bop_split.gt / "000002" / "scene_gt_info.json").unlink()
    with pytest.raises(ValueError, match=r"scene_gt_info\.json: the file cannot be read"):
        read_truth(bop_split.gt)


def test_targets_are_images(tmp_path):
    path = tmp_path / "targets.json"
    path.write_text(json.dumps([{"scene_id": 2, "im_id": 3, "obj_id": 1}, {"scene_id": 2, "im_id": 3, "obj_id": 4}]))
    assert read_targets(path) == {(2, 3)}
    path.write_text(json.dumps([{"scene": 2}]))
    with pytest.raises(ValueError, match="must hold a list of objects with scene_id and im_id"):
        read_targets(path)
