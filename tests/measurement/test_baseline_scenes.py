"""The classical baselines over scenes: results beside the truth, its time, and the same from two processes."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from attentionvote.baselines.settings import FpfhSettings, PpfSettings
from attentionvote.data.sensing import CloudSettings, measure
from attentionvote.measurement.baseline_scenes import VARIANTS, BaselineSettings, baseline_results, identity
from attentionvote.part import Part
from attentionvote.scene import Scene
from attentionvote.simulation.raycast import PartCaster
from attentionvote.simulation.scene_set import SceneSet
from attentionvote.simulation.sensor import Sensor

QUICK = PpfSettings(sampling=0.12, reference_step=4, hypotheses=10, score="fit", fit_distance=0.03)
QUICK_FPFH = FpfhSettings(
    sampling=0.07, feature_radius=0.3, neighborhood=0.9, reference_step=30, iterations=1000, fit_distance=0.03
)
BOTH = pytest.mark.parametrize("settings", [QUICK, QUICK_FPFH], ids=["ppf", "fpfh"])


@pytest.fixture(scope="module")
def scenes(box: Part, make_scenes: Callable[..., SceneSet]) -> list[Scene]:
    """One box, two boxes, and a picture without any."""
    caster, settings = PartCaster(box), CloudSettings(Sensor("gaussian", sigma_mm=0.1), density=6000, pool=6000)
    seen = [measure(record, caster, settings) for record in make_scenes((1, 2))]
    unseen = [measure(record, caster, settings) for record in make_scenes((1,), away=True)]
    assert [len(scene.points) > 500 for scene in (*seen, *unseen)] == [True, True, False]
    return [*seen, *unseen]


@BOTH
def test_every_scene_has_its_results_truth_and_time(box: Part, scenes: list[Scene], settings: BaselineSettings) -> None:
    results, seconds = baseline_results(box, scenes, settings)
    assert seconds.shape == (3,)
    assert (seconds[:2] > seconds[2]).all()  # nothing to search costs nothing; no training is in the time
    for scene, result in zip(scenes, results, strict=True):
        np.testing.assert_array_equal(result.gt_poses, scene.camera_from_part)
        np.testing.assert_allclose(result.gt_occlusion, 1 - np.minimum(scene.visible_fraction, 1))
    assert len(results[2].poses) == 0
    # The box has no symmetry here and its sides are alike, so only the place is asked for; histograms of its flat sides
    # hold it by the edges only.
    offset = np.linalg.norm(results[0].poses[0, :3, 3] - scenes[0].camera_from_part[0, :3, 3])
    assert offset < (0.15 if settings is QUICK else 0.3) * box.diameter


def test_normals_are_estimated_where_a_scene_has_none(box: Part, scenes: list[Scene]) -> None:
    with_normals, _ = baseline_results(box, scenes[:1], QUICK)
    without, _ = baseline_results(box, [replace(scenes[0], normals=None), replace(scenes[2], normals=None)], QUICK)
    np.testing.assert_allclose(without[0].poses, with_normals[0].poses, atol=1e-9)
    assert len(without[1].poses) == 0


@BOTH
def test_two_processes_find_the_same(box: Part, scenes: list[Scene], settings: BaselineSettings) -> None:
    (one, _), (two, seconds) = (baseline_results(box, scenes, settings, workers=workers) for workers in (1, 2))
    for here, there in zip(one, two, strict=True):
        np.testing.assert_array_equal(here.poses, there.poses)
        np.testing.assert_array_equal(here.scores, there.scores)
    assert (seconds > 0).all()


@pytest.mark.parametrize(
    ("module", "settings", "said"),
    [
        ("cv2", QUICK, r"cv2 is missing: .*\[benchmark\]"),
        ("open3d", QUICK_FPFH, r"needs open3d, .*\[train\]"),
    ],
)
def test_a_missing_library_is_said_before_any_work(
    box: Part,
    scenes: list[Scene],
    monkeypatch: pytest.MonkeyPatch,
    module: str,
    settings: BaselineSettings,
    said: str,
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ValueError, match=said):
        baseline_results(box, scenes, settings, workers=2)


def test_what_was_measured_before_is_still_found(box: Part, monkeypatch: pytest.MonkeyPatch) -> None:
    """The identities of the baseline's stored results: those of PPF are as they were before there was another."""
    monkeypatch.setattr("attentionvote.measurement.baseline_scenes.package_version", lambda _: "5.0.0")
    keys = {name: identity(settings, "d" * 64, box)[:12] for name, settings in VARIANTS.items()}
    before = {"ppf": "6d02c1094d5d", "ppf_icp": "2df73e1a15da", "ppf_icp_fit": "9805c7f53514"}
    assert {name: keys[name] for name in before} == before
    assert len(set(keys.values())) == len(keys)
    other = replace(QUICK_FPFH, iterations=301)
    assert len({identity(settings, "d" * 64, box) for settings in (QUICK_FPFH, other)}) == 2
    assert identity(QUICK_FPFH, "e" * 64, box) != identity(QUICK_FPFH, "d" * 64, box)
