"""The verb score on BOP's files: from the command line to the JSON line, and one sentence for what is wrong."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest
import score
from bop_split import HEADER, BopSplit, csv_row, write_ply

from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.workflows.settings import ScoreSettings


def words(split: BopSplit, *more: str) -> list[str]:
    return [f"gt={split.gt}", f"results={split.results}", f"models={split.models}", *more]


def run(split: BopSplit, *more: str) -> dict:
    return score.run(compose(ScoreSettings, words(split, *more)))


def exact_rows(split: BopSplit) -> list[str]:
    """A row for every true pose."""
    rows = []
    for folder in sorted(split.gt.iterdir()):
        for image, entries in json.loads((folder / "scene_gt.json").read_text()).items():
            for entry in entries:
                place = int(folder.name), int(image), entry["obj_id"]
                rows.append(csv_row(*place, 0.5, entry["cam_R_m2c"], entry["cam_t_m2c"], 0.25))
    return rows


def test_the_truth_as_results_scores_one_as_a_command(bop_split: BopSplit) -> None:
    bop_split.write(exact_rows(bop_split))
    command = [sys.executable, score.__file__, *words(bop_split)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") == 1
    result = json.loads(done.stdout)
    assert (result["stage"], result["format"], result["method"]) == ("score", "bop", "ours-v2")
    assert (result["dataset"], result["images"], result["seconds_per_image"]) == ("tiny-val", 3, 0.25)
    assert (result["bop25_mAP"], result["bop25_mAP_mm"]) == (1.0, 1.0)
    assert sorted(result["per_object"]) == ["1", "5", "7"]
    assert result["thresholds"] == pytest.approx(np.linspace(0.05, 0.5, 10))
    assert result["targets"] == sum(o["targets"] for o in result["per_object"].values()) < 27 == result["estimates"]
    assert "ours-v2 on tiny-val, 3 images" in done.stderr


def test_the_settings_reach_the_figures(bop_split: BopSplit) -> None:
    whole = run(bop_split)
    assert 0.1 < whole["bop25_mAP"] < 0.95
    assert (whole["result_limit"], whole["beyond_limit"], whole["outside_targets"]) == (100, 0, 0)
    cut = run(bop_split, "result_limit=3")
    assert (cut["estimates"] + cut["elsewhere"], cut["result_limit"]) == (9, 3)
    assert cut["bop25_mAP"] < whole["bop25_mAP"]
    targets = bop_split.root / "targets.json"
    targets.write_text(json.dumps([{"scene_id": 1, "im_id": 4}]))
    few = run(bop_split, f"targets={targets}")
    assert (few["images"], few["outside_targets"] > 0) == (1, True)
    assert few["estimates"] + few["elsewhere"] + few["outside_targets"] == whole["estimates"] + whole["elsewhere"]
    for folder in bop_split.gt.iterdir():
        for name in ("scene_gt", "scene_gt_info"):
            (folder / f"{name}.json").rename(folder / f"{name}_xyz.json")
    assert run(bop_split, "suffix=xyz")["bop25_mAP"] == whole["bop25_mAP"]
    twin = bop_split.results.with_name("ours_xyzibd-val.csv")
    shutil.copy(bop_split.results, twin)
    assert run(bop_split, f"results={twin}", "suffix=xyz")["result_limit"] == 200


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (["models=null"], "models must be given to score a BOP CSV, e.g. models=ipd/models"),
        (["poseutils=x"], "poseutils must not be given to score a BOP CSV, got x"),
        (["models=nowhere"], r"nowhere/models_info.json: the file cannot be read"),
        (["suffix=photoneo"], r"with scene_gt_photoneo\.json is needed, got none, but there is scene_gt\.json"),
        (["targets=nowhere.json"], r"nowhere\.json: the file cannot be read"),
    ],
)
def test_impossible_requests_are_one_sentence(bop_split: BopSplit, change: list[str], text: str) -> None:
    with pytest.raises(ConfigurationError, match=text):
        run(bop_split, *change)


def test_symmetries_that_are_none_are_one_sentence(bop_split: BopSplit) -> None:
    path = bop_split.models / "models_info.json"
    infos = json.loads(path.read_text())
    infos["7"]["symmetries_continuous"][0]["axis"] = [0, 0, 0]
    path.write_text(json.dumps(infos))
    with pytest.raises(ConfigurationError, match=r"object 7: sym.*\[0\]: axis must have a direction, got \[0, 0, 0\]"):
        run(bop_split)
    path.write_text(json.dumps(infos).replace('"7"', '"05"'))
    with pytest.raises(ConfigurationError, match="got '05': it is there beside '5', which is the same object"):
        run(bop_split)


def test_files_that_cannot_be_scored_are_one_sentence(bop_split: BopSplit) -> None:
    targets = bop_split.root / "targets.json"
    targets.write_text(json.dumps([{"scene_id": 1, "im_id": 5}]))
    with pytest.raises(ConfigurationError, match=r"every target must be in .*val, got scene 1, im 5"):
        run(bop_split, f"targets={targets}")
    rows = bop_split.rows()
    bop_split.write([*rows, csv_row(8, 0, 1, 0.5, np.eye(3), [0, 0, 800])])
    with pytest.raises(ConfigurationError, match="got 1 results without, the first is of scene 8, image 0"):
        run(bop_split)
    bop_split.write(rows, header=HEADER.replace("obj_id", "object"))
    with pytest.raises(ConfigurationError, match="the first line must be scene_id,im_id,obj_id"):
        run(bop_split)
    bop_split.write(rows)
    model = bop_split.models / "obj_000005.ply"
    model.write_text("solid")
    with pytest.raises(ConfigurationError, match=r"obj_000005\.ply: the model cannot be read, its header"):
        run(bop_split)
    write_ply(model, np.eye(3) * 0.07)
    with pytest.raises(ConfigurationError, match=r"000005\.ply: the model must be as large as its diameter in mod"):
        run(bop_split)
    model.unlink()
    with pytest.raises(ConfigurationError, match=r"obj_000005\.ply: the model cannot be read \(No such file"):
        run(bop_split)
    lost = bop_split.results.with_name("my_method_tiny-val.csv")
    bop_split.results.rename(lost)
    with pytest.raises(ConfigurationError, match=r"did you mean 'my-method_tiny-val\.csv'"):
        run(bop_split, f"results={lost}")
