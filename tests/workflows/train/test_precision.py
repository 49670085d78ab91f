"""The precision that ``auto`` means, and that it tells trainings apart only where it is not a CPU's."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from tiny_training import TINY_TRAINING

from attentionvote.command.configuration import compose
from attentionvote.command.identity import identity
from attentionvote.workflows.train import precision as precision_module
from attentionvote.workflows.train.job import find_training
from attentionvote.workflows.train.precision import check_precision, device_type, resolved_precision
from attentionvote.workflows.train.settings import TrainSettings


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Callable[[int | None, str], None]:
    """Makes this machine one with a GPU of a generation, and a build of torch."""

    def become(generation: int | None, build: str = "+cu128") -> None:
        monkeypatch.setattr(precision_module, "gpu_generation", lambda: generation)
        monkeypatch.setattr(precision_module, "version", lambda _: f"2.13.0{build}")

    return become


def settings(*words: str) -> TrainSettings:
    return compose(TrainSettings, ["object=brick", *TINY_TRAINING, *words])


@pytest.mark.parametrize(
    ("generation", "build", "accelerator", "expected"),
    [
        (9, "+cu128", "auto", "bf16-mixed"),
        (8, "", "gpu", "bf16-mixed"),
        (8, "+cu128", "cuda", "bf16-mixed"),
        (9, "+cu128", "cpu", "32-true"),
        (9, "+cu128", "mps", "32-true"),
        (7, "+cu128", "auto", "32-true"),
        (9, "+cpu", "auto", "32-true"),
        (None, "+cu128", "auto", "32-true"),
    ],
)
def test_auto_follows_the_accelerator_that_is_used(
    machine: Any, generation: int | None, build: str, accelerator: str, expected: str
) -> None:
    machine(generation, build)
    trainer = settings("trainer.precision=auto", f"trainer.accelerator={accelerator}").trainer
    assert resolved_precision(trainer) == expected
    assert resolved_precision(replace(trainer, precision="64-true")) == "64-true"


def test_the_machine_that_trains_may_be_another(machine: Any) -> None:
    trainer = settings("trainer.precision=auto", "trainer.accelerator=auto").trainer
    machine(None)
    assert resolved_precision(trainer, gpu=True) == "bf16-mixed"
    machine(9)
    assert resolved_precision(trainer, gpu=False) == "32-true"


def test_a_training_of_a_gpu_is_another_training_than_that_of_a_cpu(machine: Any, tmp_path: Path) -> None:
    words = "trainer.accelerator=auto", f"outputs={tmp_path}"
    auto = settings("trainer.precision=auto", *words)
    machine(None)
    on_cpu = find_training(auto)
    assert on_cpu.precision == "32-true"
    # "auto" as it was composed, as every training on a CPU is named.
    plain = identity(auto)
    del plain["data"]["held_out"], plain["data"]["dataset"]
    assert plain["trainer"]["precision"] == "auto"
    text = json.dumps([plain, on_cpu.part.digest], sort_keys=True)
    assert on_cpu.directory.name == hashlib.sha256(text.encode()).hexdigest()[:12]
    machine(9)
    on_gpu = find_training(auto)
    assert on_gpu.precision == "bf16-mixed"
    assert on_gpu.directory != on_cpu.directory
    named = find_training(settings("trainer.precision=bf16-mixed", *words))
    assert named.directory == on_gpu.directory  # what is trained counts, not how it was asked for
    assert find_training(settings("trainer.precision=auto", "trainer.accelerator=cpu")).precision == "32-true"


def test_half_precision_on_a_cpu_is_refused() -> None:
    with pytest.raises(
        ValueError, match=r"^trainer.precision=16-mixed must be trained on a GPU, got the CPU, .*32-true$"
    ):
        check_precision("16-mixed", "16-mixed", "cpu")
    with pytest.raises(ValueError, match=r"^trainer.precision=auto means bf16-mixed .* set trainer.accelerator=cpu$"):
        check_precision("auto", "bf16-mixed", "cpu")
    for setting, precision, device in [
        ("16-mixed", "16-mixed", "cuda"), ("auto", "bf16-mixed", "cuda"), ("bf16-mixed", "bf16-mixed", "cpu"),
        ("auto", "32-true", "cpu"),
    ]:  # fmt: skip
        check_precision(setting, precision, device)


def test_the_device_is_the_one_that_lightning_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    assert [device_type(name) for name in ("cpu", "gpu", "cuda", "mps")] == ["cpu", "cuda", "cuda", "mps"]
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    assert device_type("auto") == "cuda"
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr("torch.backends.mps.is_available", lambda: False)
    assert device_type("auto") == "cpu"
