"""Sileane's JSON files: what others write is read, and what is wrong is named in one sentence."""

from __future__ import annotations

import json

import numpy as np
import pytest
from result_writing import write_ground_truth, write_results

from attentionvote.evaluation import read_scene_results
from attentionvote.evaluation.result_files import read_ground_truth, read_results


def entry(**change) -> dict:
    return {"R": np.eye(3).tolist(), "t": [0.1, 0.2, 0.3], "score": 1.5} | change


def test_files_are_read_exactly(tmp_path, make_poses):
    rng = np.random.default_rng(0)
    poses, scores, occlusion = make_poses(rng, 5), rng.random(5) * 300, rng.random(5)
    write_results(tmp_path / "deep" / "a.json", poses, scores)
    write_ground_truth(tmp_path / "b.json", poses, occlusion)
    for (got, values), wanted in (
        (read_results(tmp_path / "deep" / "a.json"), scores),
        (read_ground_truth(tmp_path / "b.json"), occlusion),
    ):
        np.testing.assert_array_equal(got, poses)
        np.testing.assert_array_equal(values, wanted)


def test_rows_of_r_are_rows(tmp_path):
    turn = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    (tmp_path / "a.json").write_text(json.dumps([entry(R=turn, t=[[1], [2], [3]])]))
    pose = read_results(tmp_path / "a.json")[0][0]
    assert (pose @ [1, 0, 0, 1]).tolist() == [1, 3, 3, 1]


def test_no_result_is_an_empty_list(tmp_path):
    write_results(tmp_path / "a.json", np.zeros((0, 4, 4)), [])
    poses, scores = read_results(tmp_path / "a.json")
    assert (poses.shape, scores.shape) == ((0, 4, 4), (0,))


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("{", "the file must be JSON, got Expecting"),
        ("{}", "the file must hold a list of poses, got dict"),
        ("[3]", "entry 0 must be an object with R, t and score, got 3"),
        (json.dumps([entry(), {"R": [], "t": []}]), r"R of entry 1 must be 3x3 finite numbers, got \[\]"),
        (json.dumps([{"t": [0, 0, 0]}]), "entry 0 must have R, got only t"),
        (json.dumps([entry(t=[1, 2])]), r"t of entry 0 must be three finite numbers, got \[1, 2\]"),
        (json.dumps([entry(score="high")]), "score of entry 0 must be a finite number, got 'high'"),
        (json.dumps([entry(score=float("nan"))]), "score of entry 0 must be a finite number, got nan"),
        (json.dumps([entry(R=(2 * np.eye(3)).tolist())]), "R of entry 0 must be a rotation .* got a deviation of 3"),
        (json.dumps([entry(R=np.diag([1.0, 1, -1]).tolist())]), "R of entry 0 must be a rotation .* determinant -1"),
    ],
)
def test_reading_names_file_entry_and_rule(tmp_path, content, text):
    path = tmp_path / "scene.json"
    path.write_text(content)
    with pytest.raises(ValueError, match=text) as caught:
        read_results(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_reading_a_missing_file_is_one_sentence(tmp_path):
    with pytest.raises(ValueError, match="the file cannot be read \\(No such file or directory\\)"):
        read_ground_truth(tmp_path / "none.json")


def test_scenes_are_those_with_a_result_file(tmp_path):
    gt, results = tmp_path / "gt", tmp_path / "results"
    for name in ("b", "a", "c"):
        write_ground_truth(gt / f"{name}.json", np.eye(4), [0.2])
    write_results(results / "c.json", [], [])
    write_results(results / "a.json", np.eye(4), [7])
    scenes = read_scene_results(gt, results)
    assert list(scenes) == ["a", "c"]
    assert (scenes["a"].scores.tolist(), scenes["c"].scores.tolist()) == ([7], [])
    assert scenes["a"].gt_occlusion.tolist() == [0.2]


def test_scenes_need_folders_results_and_ground_truth(tmp_path):
    gt, results = tmp_path / "gt", tmp_path / "results"
    with pytest.raises(ValueError, match=r"gt: the folder of NAME.json files does not exist"):
        read_scene_results(gt, results)
    gt.mkdir()
    results.mkdir()
    with pytest.raises(ValueError, match=r"at least one NAME.json of results is needed, got none"):
        read_scene_results(gt, results)
    write_results(results / "lost.json", [], [])
    with pytest.raises(ValueError, match=r"got 1 without, the first is lost.json"):
        read_scene_results(gt, results)
