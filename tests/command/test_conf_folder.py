"""A folder of the user's beside conf/: its files are chosen, its modules named, everywhere as the project's are."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from attentionvote.command.conf_folder import CONF, VARIABLE, add_folder, choices, groups
from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.workflows.train.settings import TrainSettings

ROOT = Path(__file__).resolve().parents[2]
EXPERIMENT = """# @package _global_
defaults:
  - compact
  - override /callbacks: [stop, early_stopping]
seed: 7
trainer:
  max_epochs: 40
"""
CALLBACK = """
from lightning.pytorch.callbacks import Callback
class Stop(Callback):
    def __init__(self, after: int) -> None: self.after = after
    def on_train_epoch_end(self, trainer, module):
        print("my callback, epoch", trainer.current_epoch)
        trainer.should_stop = trainer.current_epoch + 1 >= self.after
"""
STOP = "stop: {_target_: my_callbacks.Stop, after: 2}"


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user's folder, in another place than the project's."""
    folder = tmp_path / "it's mine, [really]"
    for name, text in {
        "experiment/mine.yaml": EXPERIMENT, "callbacks/stop.yaml": STOP, "my_callbacks.py": CALLBACK
    }.items():  # fmt: skip
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.syspath_prepend(str(folder))
    return folder


def test_its_files_are_chosen_as_the_projects_are(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "")  # put back afterwards
    add_folder(own)
    assert {"mine", "compact"} <= set(choices("experiment"))
    assert "callbacks" in groups()
    cfg = compose(TrainSettings, ["object=brick", "experiment=mine", "callbacks.stop.after=3"])
    assert (cfg.seed, cfg.trainer.max_epochs, list(cfg.callbacks)) == (7, 40, ["stop", "early_stopping"])
    assert cfg.callbacks["stop"]().after == 3
    with pytest.raises(ConfigurationError, match=r"experiment must be one of .*mine.*; got 'mien', did"):
        compose(TrainSettings, ["object=brick", "experiment=mien"])
    with pytest.raises(ConfigurationError, match=r"no setting 'callbacks\.stop\.aftr', did you mean"):
        compose(TrainSettings, ["object=brick", "experiment=mine", "+callbacks.stop.aftr=3"])


def test_a_folder_that_cannot_be_added_is_one_sentence(own: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=f"^the configuration folder must exist, got {tmp_path}/no$"):
        add_folder(tmp_path / "no")
    (own / "experiment" / "compact.yaml").write_text("{}")
    with pytest.raises(ConfigurationError, match=r"must not have a file of the project's name, got .*compact\.yaml"):
        add_folder(own)
    assert VARIABLE not in os.environ


def train(*words: str, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "pipelines/train.py", *words],
        cwd=ROOT, capture_output=True, text=True, timeout=120, env={**os.environ, **variables}, check=False,
    )  # fmt: skip


@pytest.mark.parametrize("how", ["flag", "variable"])
def test_a_verb_takes_the_folder_as_hydra_does(own: Path, how: str) -> None:
    words = ["object=brick", "experiment=mine", "callbacks.stop.after=0.5"]
    done = train("--config-dir", str(own), *words) if how == "flag" else train(*words, **{VARIABLE: str(own)})
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == "train: callbacks.stop.after must be a whole number; got 0.5"


def test_shown_and_checked_with_it(own: Path) -> None:
    shown = train("--config-dir", str(own), "object=brick", "experiment=mine", "--cfg", "job")
    assert (shown.returncode, shown.stdout.count("my_callbacks.Stop")) == (0, 1), shown.stderr
    explained = train("--config-dir", str(own), "--help")
    assert " | mine" in explained.stdout
    refused = train("--config-dir", str(own), "object=brick", "trainer.average_decay=1.5")
    assert refused.returncode == 2
    assert "trainer.average_decay must be at least 0 and at most 0.999999; got 1.5" in refused.stderr


def test_a_configuration_with_another_name_is_checked_as_the_verbs_is(own: Path) -> None:
    (own / "other.yaml").write_text("defaults: [train, _self_]\nseed: -3\n", encoding="utf-8")
    words = ["--config-dir", str(own), "object=brick"]
    refused = train(*words, "--config-name=other")
    assert refused.stderr.splitlines()[-1] == "train: seed must be at least 0 and at most 4294967295; got -3"
    missing = train(*words, "--config-name=othr")
    assert missing.returncode == 2
    assert missing.stderr.splitlines()[-1].startswith(f"train: --config-name must name a file of {CONF} or {own}, got")


def test_a_stored_configuration_is_taken_whole(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = compose(TrainSettings, ["object=brick", "experiment=smoke", "seed=11"])
    (own / "stored.yaml").write_text(plain.yaml(), encoding="utf-8")
    shown = train("--config-dir", str(own), "--config-name=stored", "trainer.max_epochs=3", "--cfg=job")
    assert shown.returncode == 0, shown.stderr
    assert "seed: 11" in shown.stdout
    monkeypatch.setenv(VARIABLE, str(own))
    again = compose(TrainSettings, [], name="stored")
    assert json.dumps(again.composed, sort_keys=True) == json.dumps(plain.composed, sort_keys=True)
