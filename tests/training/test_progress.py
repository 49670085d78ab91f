"""The bar and the lines that a person sees."""

from __future__ import annotations

import io
import re
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from rich.console import Console

from attentionvote.training import progress
from attentionvote.training.progress import TrainingProgress


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(progress, "time", clock)
    return clock


def trainer(step: int, **metrics: float) -> Any:
    named = {k.replace("__", "/"): torch.tensor(v) for k, v in metrics.items()}
    return SimpleNamespace(
        global_step=step, estimated_stepping_batches=200, callback_metrics=named, sanity_checking=False
    )


SCORES = {"val__ap_10": 0.91, "val__ap_5": 0.5, "val__ap_2": 0.125}


def test_lines_where_there_is_no_terminal(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    bar = TrainingProgress(Console(file=io.StringIO()))
    bar.on_train_start(trainer(0), None)  # type: ignore[arg-type]
    clock.now += 30
    bar.on_train_batch_end(trainer(30, train__loss__vote=2.0), None)  # type: ignore[arg-type]
    assert capsys.readouterr().err == ""
    clock.now += 31
    bar.on_train_batch_end(trainer(61, train__loss__vote=1.5), None)  # type: ignore[arg-type]
    assert capsys.readouterr().err == "step 61 of 200: vote 1.50, 2 min left\n"
    clock.now += 39
    bar.on_validation_end(trainer(100, train__loss__vote=1.0, **SCORES), None)  # type: ignore[arg-type]
    expected = "step 100 of 200: vote 1.00, AP 0.910/0.500/0.125 at 10/5/2 % D, 100 s left\n"
    assert capsys.readouterr().err == expected
    bar.on_validation_end(trainer(110), None)  # type: ignore[arg-type]
    assert capsys.readouterr() == ("", "")


def test_a_bar_on_a_terminal(clock: Clock) -> None:
    screen = io.StringIO()
    bar = TrainingProgress(Console(file=screen, force_terminal=True, width=160))
    bar.on_train_start(trainer(0), None)  # type: ignore[arg-type]
    bar.on_validation_end(trainer(50, **SCORES), None)  # type: ignore[arg-type]
    clock.now += 2
    bar.on_train_batch_end(trainer(80, train__loss__vote=1.25), None)  # type: ignore[arg-type]
    bar.on_train_end(trainer(200), None)  # type: ignore[arg-type]
    assert bar.bar is None
    shown = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", screen.getvalue())
    assert "200/200" in shown
    assert "AP 0.910/0.500/0.125  vote 1.25" in shown
    assert screen.getvalue().endswith("\x1b[?25h")  # the cursor is back


def test_the_terminal_is_left_as_it_was_after_an_error(clock: Clock) -> None:
    del clock
    screen = io.StringIO()
    bar = TrainingProgress(Console(file=screen, force_terminal=True, width=160))
    bar.on_train_start(trainer(0), None)  # type: ignore[arg-type]
    bar.on_exception(trainer(3), None, KeyboardInterrupt())  # type: ignore[arg-type]
    assert bar.bar is None
    assert screen.getvalue().endswith("\x1b[?25h")


def test_seconds_are_counted_over_interruptions(clock: Clock) -> None:
    first = TrainingProgress(Console(file=io.StringIO()))
    first.on_train_start(trainer(0), None)  # type: ignore[arg-type]
    clock.now += 50
    state = first.state_dict()
    clock.now += 1000  # killed, found the next morning
    second = TrainingProgress(Console(file=io.StringIO()))
    second.load_state_dict(state)
    clock.now += 5  # until training starts
    second.on_train_start(trainer(100), None)  # type: ignore[arg-type]
    clock.now += 20
    second.on_train_end(trainer(200), None)  # type: ignore[arg-type]
    assert second.seconds == pytest.approx(70)
    complete = TrainingProgress(Console(file=io.StringIO()))
    complete.load_state_dict(state)
    assert complete.seconds == pytest.approx(50)
