"""From a registered version back to its making: equal to the bit here, compared within an interval elsewhere."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest
import train
import warm_starter
import yaml
from reproduce import run as reproduce
from tiny_training import TINY_TRAINING

from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError, Refused
from attentionvote.tracking.store import connect, resolve_store
from attentionvote.workflows import reproduce as room
from attentionvote.workflows.settings import ReproduceSettings
from attentionvote.workflows.train.settings import TrainSettings

pytestmark = pytest.mark.usefixtures("quick_training")
TINY = [
    "object=brick", *TINY_TRAINING, "simulation.drop_counts=[1,2]", "workers=1", "trainer.max_epochs=4",
    "simulation.cycles.test=2",
    "trainer.validate_every=2", "force=false", "object.title='A brick, \"quoted\"'",
]  # fmt: skip


class Registry:
    """Versions of trainings, without bundles: what is registered is of no interest here, but its run."""

    def __init__(self, folder: Path, store: str) -> None:
        self.folder, self.store = folder, store
        self.client = connect(resolve_store(store))
        self.client.create_registered_model("attentionvote-brick")
        self.first = self.train()
        self.register(self.first, champion=True)

    def train(self, *more: str) -> dict[str, Any]:
        where = [f"root={self.folder / 'data'}", f"outputs={self.folder / 'out'}", f"tracking.store={self.store}"]
        answer: dict[str, Any] = json.loads(json.dumps(train.run(compose(TrainSettings, [*TINY, *where, *more]))))
        return answer

    def register(self, trained: dict[str, Any], champion: bool = False) -> str:
        source = f"runs:/{trained['run_id']}/checkpoints"
        version = self.client.create_model_version("attentionvote-brick", source, run_id=trained["run_id"])
        if champion:
            self.client.set_registered_model_alias("attentionvote-brick", "champion", version.version)
        return str(version.version)

    def reproduce(self, outputs: str = "again", *words: str) -> dict[str, Any]:
        where = [f"tracking.store={self.store}", f"outputs={self.folder / outputs}", "workers=1"]
        return reproduce(compose(ReproduceSettings, ["object=brick", *where, *words]))


@pytest.fixture(scope="module")
def registry(tmp_path_factory: pytest.TempPathFactory, store: str) -> Registry:
    return Registry(tmp_path_factory.mktemp("registry"), store)


@pytest.fixture(autouse=True)
def warm_jobs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "Popen", warm_starter.Popen)


@pytest.mark.slow
def test_a_champion_is_made_again_to_the_bit(registry: Registry) -> None:
    answer = registry.reproduce()
    assert (answer["verdict"], answer["version"], answer["run_id"]) == ("equal", 1, registry.first["run_id"])
    assert answer["scenes_equal"]
    assert answer["weights_equal"]
    assert answer["again"] != registry.first["run_id"]
    assert json.loads((registry.folder / "again" / "brick" / "version-1.json").read_text()) == answer
    assert registry.reproduce("again", "version=1") == answer  # complete: nothing is trained a second time


@pytest.mark.slow
def test_other_weights_are_compared_on_the_same_scenes(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another seed's weights in the run stand for another machine's."""
    other = registry.train("trainer.learning_rate=0.002")
    version = registry.register(other)
    registry.client.log_artifact(other["run_id"], registry.first["model"], "checkpoints")
    answer = registry.reproduce("again", f"version={version}")
    assert (answer["verdict"], answer["weights_equal"]) == ("within", False)
    assert answer["difference"].keys() == {"ap_10", "ap_5", "ap_2"}
    for value, low, high in answer["difference"].values():
        assert low <= value <= high
    cfg = compose(ReproduceSettings, ["object=brick", f"outputs={registry.folder / 'again'}", "workers=1"])
    was = room.Recorded(int(version), "", {**compose(TrainSettings, TINY).composed}, {}, {}, {}, Path(other["model"]))
    was.settings["simulation"]["cycles"]["test"] = 1
    with pytest.raises(ValueError, match=rf"the test of version {version} must have at least two drop cycles for an"):
        room.paired_difference(was, registry.first, cfg)
    monkeypatch.setattr(room, "paired_difference", lambda *_: {"ap_10": [-0.1, -0.2, -0.01], "ap_5": [0, -1, 1]})
    with pytest.raises(Refused, match=rf"version {version} is not reproduced: ap_10 differ by more than"):
        registry.reproduce("again", f"version={version}")


@pytest.mark.slow
def test_settings_that_make_other_scenes_are_said(registry: Registry, tmp_path: Path) -> None:
    version = registry.register(registry.first)
    config = Path(registry.client.download_artifacts(registry.first["run_id"], "config.yaml", str(tmp_path)))
    settings = yaml.safe_load(config.read_text())
    assert settings["object"]["title"] == 'A brick, "quoted"'
    settings["seed"] = 9
    settings["simulation"]["seed"] = 9
    other = registry.train("trainer.max_epochs=2")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "config.yaml").write_text(yaml.safe_dump(settings))
    registry.client.log_artifact(other["run_id"], str(tmp_path / "other" / "config.yaml"))
    version = registry.register(other)
    with pytest.raises(Refused, match=r"the train scenes must be those of version \d, .* made .* here") as refused:
        registry.reproduce("again", f"version={version}")
    assert refused.value.result["verdict"] == "other scenes"


def test_what_is_not_there_is_one_sentence(registry: Registry) -> None:
    with pytest.raises(ConfigurationError, match=r"^attentionvote-brick must have version 77, it has 1"):
        registry.reproduce("none", "version=77")
    run_id = registry.client.create_run(
        registry.client.get_run(registry.first["run_id"]).info.experiment_id
    ).info.run_id
    version = registry.register({"run_id": run_id})
    with pytest.raises(ConfigurationError, match=rf"the run {run_id} of version {version} must be in the store with"):
        registry.reproduce("none", f"version={version}")


def test_what_differs_is_listed() -> None:
    then = {"git.commit": "0" * 40, "hardware.cpu": "Z80", "version.torch": "0.1", "version.gone": "1"}
    differs = room.differences(then)
    assert {name: then for name, (then, _) in differs.items()} == {k: then[k] for k in list(then)[:3]}
    assert all(now not in ("", "0.1") for _, now in differs.values())
