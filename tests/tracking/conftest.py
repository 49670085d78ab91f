"""One store for all (its tables take seconds), a run of its own for each test."""

import pytest

from attentionvote import tracking


@pytest.fixture(scope="session")
def store(tmp_path_factory):
    return f"sqlite:///{tmp_path_factory.mktemp('tracking')}/mlflow.db"


@pytest.fixture
def run(store):
    run = tracking.start_run(store, "rod", name="test", system_interval_s=0)
    yield run
    run.close("FINISHED")
