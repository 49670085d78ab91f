"""The verb score on Sileane's files: the published figures, through the verb, and one sentence for what is wrong.

What the functions below the verb give on the same data stands in tests/evaluation/test_oracle.py; here the way from
the command line to the JSON line is what is held. Expected figures: the published toolbox, as said there.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import score
from result_writing import write_ground_truth, write_results

from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.workflows.settings import ScoreSettings

# threshold_scale: AP, F1, MAP, R99, R50, TP, FP, FN
BUNNY = {
    1.0: (0.797872, 0.882159, 0.798151, 0.787418, 0.798151, 140, 2, 36),
    0.5: (0.797872, 0.882159, 0.798151, 0.787418, 0.798151, 140, 2, 36),
    0.2: (0.765357, 0.852287, 0.764020, 0.670470, 0.771455, 135, 8, 41),
    0.1: (0.698965, 0.792438, 0.702478, 0.291766, 0.716876, 125, 19, 51),
    0.05: (0.510603, 0.625113, 0.512071, 0.156084, 0.563097, 98, 48, 78),
    0.03: (0.232982, 0.387765, 0.245611, 0.006993, 0.286790, 56, 90, 120),
}
FIGURES = ("ap", "f1", "map", "r99", "r50", "tp", "fp", "fn")
SIX_DIGITS = {"rtol": 0, "atol": 5.1e-7}
CLASSES = ["none_bunny", "cyclic2_brick", "revolution_noflip_gearshaft", "revolution_flip"]


def words(folder: Path, *more: str) -> list[str]:
    return [f"gt={folder}/gt", f"results={folder}/results", f"poseutils={folder}/poseutils.json", *more]


def run(folder: Path, *more: str) -> dict:
    return score.run(compose(ScoreSettings, words(folder, *more)))


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Two scenes: one of two found, beside a stray; nothing there and nothing given. 10 mm is the threshold."""
    poses = np.stack([np.eye(4)] * 3)
    poses[1, 0, 3], poses[2, 0, 3] = 0.5, 0.9
    write_ground_truth(tmp_path / "gt" / "a.json", poses, [0.0, 0.5, 0.8])
    write_results(tmp_path / "results" / "a.json", poses[1:2] + np.eye(4, k=3) * 0.0082, [0.9])
    write_ground_truth(tmp_path / "gt" / "b.json", np.zeros((0, 4, 4)), [])
    write_results(tmp_path / "results" / "b.json", np.zeros((0, 4, 4)), [])
    utils = {"type": "AffinePoseUtils", "Lambda": np.eye(3).tolist(), "G": [np.eye(3).tolist()]}
    (tmp_path / "poseutils.json").write_text(json.dumps(utils | {"distance_threshold": 0.01}))
    return tmp_path


@pytest.mark.parametrize("scale", BUNNY)
def test_the_bunny_sample_gives_the_toolbox_figures(shared_data, scale: float) -> None:
    result = run(shared_data("sileane_bunny_sample"), f"threshold_scale={scale}")
    np.testing.assert_allclose([result[name] for name in FIGURES], BUNNY[scale], **SIX_DIGITS)
    assert (result["scenes"], len(result["per_scene"])) == (11, 11)


def test_the_command_prints_the_figures_as_one_line_and_a_table(shared_data) -> None:
    folder = shared_data("sileane_bunny_sample").resolve()
    command = [sys.executable, score.__file__, *words(folder, "occlusion=1.1", "frame=object")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") == 1
    result = json.loads(done.stdout)
    assert result["stage"] == "score"
    # All required (section 2a); the object-side frame does not change the figures at 10 %.
    np.testing.assert_allclose([result[n] for n in ("ap", "f1", "map")], (0.176266, 0.299229, 0.176348), **SIX_DIGITS)
    assert "11 scenes, threshold 23.44 mm, every pose required, object-side frame" in " ".join(done.stderr.split())
    assert "0.176266" in done.stderr


def test_per_scene_figures_are_the_toolbox_s(shared_data) -> None:
    ap = [.764706, .928571, .833333, .764706, .75, .846154, .8125, .764706, .722222, .769231, .823529]  # fmt: skip
    result = run(shared_data("sileane_bunny_sample"))
    np.testing.assert_allclose([scene["ap"] for scene in result["per_scene"].values()], ap, **SIX_DIGITS)
    assert [sum(s[name] for s in result["per_scene"].values()) for name in ("tp", "fp", "fn")] == [140, 2, 36]


@pytest.mark.parametrize("name", CLASSES)
def test_every_case_of_the_oracle_comes_through_the_verb(shared_data, name: str) -> None:
    folder = shared_data(f"bregier_oracle/{name}")
    expected = json.loads((folder / "expected.json").read_text())["metrics"]
    assert len(expected) == 6
    for key, case in expected.items():
        occlusion, scale = key.removeprefix("occ").split("_thr")
        result = run(folder, f"occlusion={occlusion}", f"threshold_scale={scale}")
        got = [result[figure] for figure in ("ap", "f1", "map")]
        np.testing.assert_allclose(got, [case["AP"], case["F1"], case["MAP"]], atol=1e-12, err_msg=key)
        for scene, lists in case["final"].items():
            counts = [result["per_scene"][scene][kind] for kind in ("tp", "fp", "fn")]
            assert counts == [len(lists[kind]) for kind in ("tp", "fp", "fn")], f"{key} {scene}"
            assert result["per_scene"][scene]["ap"] == pytest.approx(case["per_scene"][scene]["AP"], abs=1e-12)


def test_the_settings_reach_the_figures(small: Path) -> None:
    whole = run(small)
    # Recall 1/2 of scene a at precision 1; scene b, with nothing to find, has recall and precision 1.
    assert [whole[name] for name in FIGURES] == pytest.approx([0.75, 6 / 7, 0.75, 0.75, 0.75, 1, 0, 1])
    assert whole["per_scene"]["a"]["ap"] == 0.5
    assert run(small, "threshold_scale=0.5")["per_scene"]["a"] == pytest.approx(
        {"ap": 0, "f1": 0, "map": 0, "r99": 0, "r50": 0, "tp": 0, "fp": 1, "fn": 2, "precision": 0, "recall": 0}
    )
    assert run(small, "occlusion=0.4")["per_scene"]["a"]["fn"] == 1
    assert run(small, "occlusion=0.9")["per_scene"]["a"]["ap"] == pytest.approx(1 / 3)
    curve = run(small, "curve=true")["curve"]
    assert curve["threshold_m"] == pytest.approx(np.linspace(0, 0.01, 21))
    assert curve["ap"] == pytest.approx([0.5] * 17 + [0.75] * 4)  # right from 8.2 mm on; scene b always is
    assert "curve" not in whole


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (["gt=''"], "gt must be given, e.g. gt=test/gt"),
        (["results=nowhere"], "results must be a file or folder that is there, got nowhere"),
        (["poseutils=null"], "poseutils must be given to score Sileane's files, e.g. poseutils="),
        (["models=x"], "models must not be given to score Sileane's files, got x"),
        (["poseutils=none.json"], r"none.json: the file cannot be read \(No such file or directory\)"),
        (["frame=part"], "frame must be one of toolbox, object; got 'part'"),
        (["frame=object"], "Rref2i must be given, got only Lambda, G, distance_threshold"),
        (["threshold_scale=0.0"], "threshold_scale must be greater than 0 and at most 100; got 0.0"),
        (["result_limit=0"], "result_limit must be a whole number at least 1 and at most 1000000; got 0"),
    ],
)
def test_impossible_requests_are_one_sentence(small: Path, change: list[str], text: str) -> None:
    with pytest.raises(ConfigurationError, match=text):
        run(small, *change)


def test_files_that_cannot_be_scored_are_one_sentence(small: Path) -> None:
    write_results(small / "results" / "c.json", np.zeros((0, 4, 4)), [])
    with pytest.raises(ConfigurationError, match=r"got 1 without, the first is c\.json"):
        run(small)
    (small / "results" / "c.json").unlink()
    millimetres = np.eye(4)
    millimetres[0, 3] = 508.0
    write_results(small / "results" / "a.json", millimetres, [0.9])
    with pytest.raises(ConfigurationError, match=r"t must be in metres, .* got a median .* 508 .* 0.5; it looks like"):
        run(small)
    (small / "results" / "a.json").write_text(json.dumps([{"r": np.eye(3).tolist(), "t": [0, 0, 0], "score": 1}]))
    with pytest.raises(ConfigurationError, match="entry 0 must have R, got only r, score, t"):
        run(small)
    with pytest.raises(ConfigurationError, match=r"results must be a folder of NAME\.json .* or a METHOD_DATASET"):
        run(small, f"results={small}/poseutils.json")
