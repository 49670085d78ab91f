"""The presets' training and validation steps on a GPU without memory: what can be right before a GPU sees it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import fake_gpu
import pytest

CASES = [
    (experiment, part, half)
    for experiment in ("gpu", "paper", "votenet")
    for part in ("connecting_rod", "industrial")
    for half in ("float32", "bf16")
]
MOST_BYTES = 2e9  # of one table of a validation step
# Of one table of a training step, whose activations its backward pass needs: the first level of 32 scenes.
MOST_TRAINING_BYTES = 2**31


@pytest.fixture(scope="module")
def answers() -> dict[str, dict[str, Any]]:
    """What every case came to, of a process of its own: the stand-in of a driver stays in it."""
    cases = list(dict.fromkeys(f"{experiment}:{part}" for experiment, part, _ in CASES))
    command = [sys.executable, "-W", "error", fake_gpu.__file__, *cases]
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(command, capture_output=True, text=True, cwd=root, env={**os.environ}, check=False)
    if done.returncode == fake_gpu.NO_GUARD:
        pytest.skip(done.stdout.strip())
    assert done.returncode == 0, done.stderr
    return {answer["case"]: answer for answer in map(json.loads, done.stdout.splitlines())}


@pytest.fixture(params=CASES, ids=" ".join)
def answer(request: pytest.FixtureRequest, answers: dict[str, dict[str, Any]]) -> dict[str, Any]:
    return answers[" ".join(request.param)]


@pytest.mark.slow
def test_losses_and_answers_are_on_the_gpu_and_in_single_precision(answer: dict[str, Any]) -> None:
    assert {"vote", "total"} <= set(answer["warm_up"]) < set(answer["terms"])
    assert {"center", "rotation", "confidence"} <= set(answer["terms"])
    assert ("semantic" in answer["terms"]) == ("industrial" in answer["case"])
    for values in (answer["warm_up"], answer["terms"], answer["predictions"]):
        assert set(values.values()) == {"cuda:0 float32"}
    assert answer["indices"] == ["torch.int64"]  # copied as int32


@pytest.mark.slow
def test_a_step_waits_twice_and_copies_nothing_but_its_batch(answer: dict[str, Any]) -> None:
    assert answer["waits"] == {
        "warm-up": {},
        "first step": {"nonzero": 1, "tolist": 1},  # which proposals, and how many of all processes
        "step": {"nonzero": 1, "tolist": 1},
        "validation": {},
    }
    assert answer["copies"]["first step"]  # the constants
    assert answer["copies"]["step"] == answer["copies"]["validation"] == {}


@pytest.mark.slow
def test_no_table_is_larger_than_a_small_gpu(answer: dict[str, Any]) -> None:
    sizes = {name: size for name, (size, _) in answer["largest"].items()}
    assert 2e7 < sizes["validation"] <= MOST_BYTES
    assert max(sizes.values()) <= MOST_TRAINING_BYTES
