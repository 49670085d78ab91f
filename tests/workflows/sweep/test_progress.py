"""What a person sees of a sweep: a line a trial, the best so far, the time left; a bar in a terminal."""

from __future__ import annotations

import io

import optuna
import pytest
from optuna.trial import FrozenTrial, TrialState
from rich.console import Console

from attentionvote.workflows.sweep.progress import SweepProgress
from attentionvote.workflows.sweep.space import Setting

SPACE = [Setting("trainer.learning_rate", "float", 0.0, 1.0)]


def trial(number: int, state: TrialState, value: float | None = None, **about: object) -> FrozenTrial:
    made = optuna.create_trial(
        state=state,
        value=value,
        params={"trainer.learning_rate": 0.0123456},
        distributions={"trainer.learning_rate": optuna.distributions.FloatDistribution(0, 1)},
        intermediate_values={4: 0.25},
        user_attrs=about,
    )
    made.number = number
    return made


def test_without_a_terminal_there_is_a_line_a_trial(capsys: pytest.CaptureFixture[str]) -> None:
    good = trial(3, TrialState.COMPLETE, 0.5)
    with SweepProgress(6, 3, 1, SPACE, Console(file=io.StringIO())) as progress:
        assert progress.left() == ""
        progress._start_s -= 6000
        progress.ended(good, good)
        progress.ended(trial(4, TrialState.PRUNED), good)
        progress.ended(trial(5, TrialState.FAIL, reason="the disk is full"), good)
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "trial 3 (4 of 6): val/ap 0.5000; trainer.learning_rate=0.0123; best 0.5000 (trial 3); 200 min left",
        "trial 4 (5 of 6): pruned at 0.2500 after 4 epochs; trainer.learning_rate=0.0123; best 0.5000 (trial 3); "
        "50 min left",
        "trial 5 (6 of 6): failed: the disk is full; trainer.learning_rate=0.0123; best 0.5000 (trial 3)",
    ]


def test_a_terminal_has_a_bar_with_the_best_and_the_time_left() -> None:
    screen = io.StringIO()
    good = trial(0, TrialState.COMPLETE, 0.5)
    with SweepProgress(2, 0, 1, SPACE, Console(file=screen, force_terminal=True, width=160)) as progress:
        progress._start_s -= 3000
        progress.ended(good, good)
        progress.tick()
    assert "1/2" in screen.getvalue()
    assert "50 min left, best 0.5000 (trial 0)" in screen.getvalue()
