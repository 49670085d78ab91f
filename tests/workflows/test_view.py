"""The verb view: a scene of a finished set, or of a cycle simulated for the picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import view

from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.simulation import scene_set
from attentionvote.simulation.part_files import load_part
from attentionvote.simulation.scene_spec import scene_set_directory, scene_set_specs
from attentionvote.workflows.settings import ViewSettings

TINY = ["object=brick", "simulation=smoke", "simulation.cycles.train=2", "simulation.drop_counts=[1,2]"]
TINY += [f"simulation.camera.camera.{key}" for key in ("width=344", "height=257", "fx=567.0", "fy=567.0")]
TINY += ["simulation.camera.camera.cx=172.0", "simulation.camera.camera.cy=128.5"]


def run(directory: Path, *overrides: str) -> dict:
    words = [*TINY, f"root={directory}/scenes", f"output={directory}/view", "max_points=2000", *overrides]
    return view.run(compose(ViewSettings, words))


def test_a_scene_looks_the_same_before_and_after_its_set_exists(tmp_path: Path) -> None:
    before = run(tmp_path, "scene=3", "sensor=phoxi")
    folder = tmp_path / "view" / "brick-train-3-phoxi"
    assert before["files"]["scene.html"] == str(folder / "scene.html")
    assert sorted(p.name for p in folder.iterdir()) == ["depth.png", "instances.png", "scene.html", "visibility.png"]
    assert before["parts"] == 2
    assert not (tmp_path / "scenes").exists()
    part = load_part("brick", "builtin:brick")
    spec = scene_set_specs(part, compose(ViewSettings, TINY).simulation)["train"]
    directory = scene_set_directory(tmp_path / "scenes", "brick", spec)
    scene_set.generate_scene_set(part, spec, directory, progress=False)
    after = run(tmp_path, "scene=3", "sensor=phoxi")
    np.testing.assert_array_equal(after["visible_fraction"], before["visible_fraction"])
    assert after["points"] == before["points"] > 100


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("scene=4", "scene must be below 4 in split train; got 4"),
        ("split=trian", "split must be one of train, val, test; got 'trian'"),
        ("sensor=foxi", "must be one of none, gaussian, phoxi[;,] got 'foxi', did you mean 'phoxi'"),
        ("sigma_mm=500.0", "^sigma_mm must be at least 0 and at most 100; got 500"),
    ],
)
def test_impossible_requests(tmp_path: Path, override: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        run(tmp_path, override)
    assert not list(tmp_path.iterdir())
