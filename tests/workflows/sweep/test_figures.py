"""The page of a sweep's figures."""

from __future__ import annotations

import json
import re

import optuna
import pytest

from attentionvote.workflows.sweep.figures import figures_page


@pytest.fixture
def study() -> optuna.Study:
    """Four complete trials, and one pruned after its first epoch."""
    study = optuna.create_study(study_name="brick-smoke", direction="maximize")
    rates = {"trainer.learning_rate": optuna.distributions.FloatDistribution(1e-4, 1e-2, log=True)}
    for value in (0.5, 0.6, 0.8, 0.7, None):
        state = optuna.trial.TrialState.PRUNED if value is None else optuna.trial.TrialState.COMPLETE
        study.add_trial(
            optuna.create_trial(
                value=value, params={"trainer.learning_rate": 0.001 * (1 + (value or 0))}, distributions=rates,
                state=state, intermediate_values={1: 0.25},
            )
        )  # fmt: skip
    return study


def test_a_page_shows_trials_and_settings_without_a_network(study: optuna.Study) -> None:
    page = figures_page(study, importances=True)
    assert re.findall(r'<div id="(\w+)"', page) == ["history", "curves", "importances", "slices", "coordinates"]
    assert not re.search(r"<script[^>]* src=", page)
    assert page.count("plotly.js v") == 1  # 4.5 MB, once
    history = re.search(r'newPlot\(\s*"history",\s*(\[.*?\]),\s*\{"t', page, re.DOTALL)
    assert history is not None
    assert json.loads(history[1])[0]["y"] == [0.5, 0.6, 0.8, 0.7]
    assert "trainer.learning_rate" in page
    assert page == figures_page(study, importances=True)


def test_too_few_trials_say_nothing_of_importances(study: optuna.Study) -> None:
    assert '<div id="importances"' not in figures_page(study, importances=False)
