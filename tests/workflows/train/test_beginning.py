"""What a training begins with: the weights of another one, or its own shorter self."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import pytest
import torch
import train
from tiny_training import TINY_TRAINING

from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.tracking.store import connect, resolve_store
from attentionvote.workflows.train.settings import TrainSettings

pytestmark = pytest.mark.usefixtures("quick_training")
TINY = [
    "object=brick", *TINY_TRAINING, "simulation.drop_counts=[1,2]", "workers=1", "trainer.max_epochs=4",
    "trainer.validate_every=2", "trainer.average_decay=0.5", "force=false", "trainer.schedule.shape=constant",
]  # fmt: skip


class Trained:
    """A training of the module's, and others beside it."""

    def __init__(self, folder: Path, store: str) -> None:
        self.folder, self.store = folder, store
        self.first = self.run()

    def run(self, *more: str, outputs: str = "out") -> dict[str, Any]:
        words = [
            *TINY,
            f"root={self.folder / 'data'}",
            f"outputs={self.folder / outputs}",
            f"tracking.store={self.store}",
        ]
        answer: dict[str, Any] = json.loads(json.dumps(train.run(compose(TrainSettings, [*words, *more]))))
        return answer


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, store: str) -> Trained:
    return Trained(tmp_path_factory.mktemp("trained"), store)


def weights(answer: dict[str, Any], name: str = "model.ckpt") -> dict[str, torch.Tensor]:
    path = Path(answer["model"]).parent
    state: dict[str, torch.Tensor] = torch.load(path / name, weights_only=True)["state_dict"]
    return state


def test_more_epochs_go_on_to_what_they_would_have_been(trained: Trained, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="attentionvote"):
        longer = trained.run("trainer.max_epochs=6")
    assert f"going on after the last epoch of {Path(trained.first['model']).parent}" in caplog.text
    whole = trained.run("trainer.max_epochs=6", outputs="whole")
    for name in ("model.ckpt", "checkpoints/last.ckpt"):
        for key, value in weights(whole, name).items():
            assert torch.equal(value, weights(longer, name)[key]), key
    assert (longer["metrics"], longer["val_ap"], longer["steps"]) == (whole["metrics"], whole["val_ap"], 12)
    assert longer["run_id"] != trained.first["run_id"]
    assert Path(trained.first["model"]).is_file()
    # The best checkpoint was written before the end of the shorter one, and lies with the longer one now.
    last = torch.load(Path(longer["model"]).with_name("checkpoints") / "last.ckpt", weights_only=True)
    assert str(Path(trained.first["model"]).parent) not in json.dumps(last["callbacks"], default=str)


def test_a_schedule_that_looks_ahead_is_trained_anew_and_said(
    trained: Trained, caplog: pytest.LogCaptureFixture
) -> None:
    words = ["trainer.schedule.shape=cosine", "trainer.max_epochs=2"]
    shorter = trained.run(*words)
    with caplog.at_level(logging.INFO, logger="attentionvote"):
        longer = trained.run(*words, "trainer.max_epochs=3")
    folder = Path(shorter["model"]).parent
    assert f"trained anew, because the learning rate and callbacks of {folder} went by its own number of" in caplog.text
    assert longer["steps"] == 6


@pytest.mark.parametrize("how", ["folder", "file", "run", "version"])
def test_a_training_begins_with_the_weights_of_another(
    trained: Trained, caplog: pytest.LogCaptureFixture, how: str
) -> None:
    model, run_id = trained.first["model"], trained.first["run_id"]
    if how == "version":
        client = connect(resolve_store(trained.store))
        client.create_registered_model("attentionvote-brick")
        client.create_model_version("attentionvote-brick", f"runs:/{run_id}/checkpoints", run_id=run_id)
        client.set_registered_model_alias("attentionvote-brick", "champion", "1")
    folder, version = str(Path(model).parent), "models:/attentionvote-brick@champion"
    init = {"folder": folder, "file": model, "run": run_id, "version": version}[how]
    with caplog.at_level(logging.INFO, logger="attentionvote"):
        answer = trained.run(f"init={init}", "trainer.learning_rate=1e-12", "trainer.max_epochs=2", outputs=how)
    assert f"of 183 weights of brick ({init})" in caplog.text
    began, ended = weights(trained.first), weights(answer)
    for name, value in began.items():
        if value.is_floating_point() and "running" not in name:
            torch.testing.assert_close(ended[name], value, atol=1e-6, rtol=0)


def test_heads_of_another_shape_are_made_anew_and_said(trained: Trained, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="attentionvote"):
        trained.run(f"init={trained.first['model']}", "model.head=[24]", "trainer.max_epochs=2")
    assert "beginning with 175 of 183 weights of brick" in caplog.text
    assert "made anew, because there they have another shape: head.0.weight, " in caplog.text


def test_it_is_known_by_its_content_and_resumed_without_it(trained: Trained, tmp_path: Path) -> None:
    copy = tmp_path / "copy.ckpt"
    copy.write_bytes(Path(trained.first["model"]).read_bytes())
    words = ["trainer.max_epochs=2", "seed=5"]
    answers = [trained.run(f"init={path}", *words) for path in (copy, trained.first["model"])]
    assert answers[0] == answers[1]
    assert answers[0]["model"] != trained.run(*words)["model"]


@pytest.mark.parametrize(
    ("init", "sentence"),
    [
        (
            "nowhere",
            r"a training's folder, the id of an MLflow run, or models:/NAME@champion; got 'nowhere'",
        ),
        ("x.ckpt", r"got 'x\.ckpt', which is no file"),
        ("models:/attentionvote-none@champion", r"got 'models:/attentionvote-none@champion', which sqlite:.* does not"),
    ],
)
def test_what_it_cannot_be_is_one_sentence(trained: Trained, init: str, sentence: str) -> None:
    with pytest.raises(ConfigurationError, match=sentence):
        trained.run(f"init={init}")
    with pytest.raises(ValueError, match=r"must name a run of .* with a complete training"):
        trained.run(f"init={'0' * 32}")
