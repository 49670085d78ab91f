"""The verb generate, in this process: what it writes, returns and refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import generate
import numpy as np
import pytest

from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.part import Part
from attentionvote.simulation.scene_set import SceneSet
from attentionvote.workflows.settings import GenerateSettings

TINY = ["object=brick", "simulation=smoke", "simulation.cycles.train=2", "simulation.drop_counts=[1,2]", "workers=1"]


def run(root: Path, *overrides: str) -> dict:
    return generate.run(compose(GenerateSettings, [*TINY, f"root={root}", *overrides]))


def test_every_split_is_generated_once(tmp_path: Path) -> None:
    result = json.loads(json.dumps(run(tmp_path)))
    assert (result["stage"], result["object"]) == ("generate", "brick")
    assert sorted(result["sets"]) == ["test", "train", "val"]
    for split, entry in result["sets"].items():
        assert Path(entry["directory"]) == tmp_path / "brick" / f"{split}-{entry['spec_digest'][:12]}"
        scenes = SceneSet.open(Path(entry["directory"]))
        assert (len(scenes), scenes.digest) == (entry["scenes"], entry["digest"])
    assert result["sets"]["train"]["scenes"] == 4
    shard = Path(result["sets"]["train"]["directory"]) / "cycles" / "00000.npz"
    written = shard.stat().st_mtime_ns
    again = run(tmp_path)
    assert again["sets"] == result["sets"]
    assert shard.stat().st_mtime_ns == written
    assert run(tmp_path, "force=true", "splits=[train]")["sets"]["train"] == result["sets"]["train"]
    assert shard.stat().st_mtime_ns > written


def test_what_the_camera_can_tell_is_said_first(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO"):
        run(tmp_path, "splits=[val]", "simulation.camera.distance=0.5")
    first = next(record.message for record in caplog.records if record.name == "attentionvote.generate")
    assert "at 500 mm: " in first
    assert "pixels across, about" in first


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("splits=[trian]", "splits must be .*train, val, test; got .*'trian'"),
        ("splits=[]", "splits must not be an empty list"),
        ("simulation.bin.jitter=0.9", "simulation.bin.jitter must be at least 0 and at most 0.5; got 0.9"),
        ("simulation.drop_counts=[3,2]", "drop_counts must be increasing numbers"),
        ("object.mesh=builtin:brik", "object brick: .*brick"),
    ],
)
def test_impossible_requests_write_nothing(tmp_path: Path, override: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        run(tmp_path / "scenes", override)
    assert not (tmp_path / "scenes").exists()


@pytest.mark.parametrize("simulation", ["default", "fast", "smoke"])
def test_the_presets_are_valid_and_spell_out_the_defaults(simulation: str) -> None:
    from attentionvote.simulation.scene_spec import SceneSetSpec, scene_set_specs

    cfg = compose(GenerateSettings, ["object=brick", f"simulation={simulation}"])
    part = Part("box", np.eye(4, 3), np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]), 1.0)
    specs = scene_set_specs(part, cfg.simulation)
    assert set(specs) == {"train", "val", "test"}
    if simulation == "default":
        assert specs["val"] == SceneSetSpec(part.digest, "val", cfg.simulation.cycles["val"])
        assert specs["train"] == replace(specs["val"], split="train", cycles=90, pile_share=0.75)
        assert specs["test"] == replace(specs["val"], split="test", cycles=30, keep_every=3)
    else:
        assert (specs["train"].drop.timestep, specs["train"].drop.contact_time) == (0.008, 0.02)
