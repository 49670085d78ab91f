"""One store of each kind for all (its tables take seconds), a run of its own for each test."""

import contextlib

import pytest

from attentionvote.tracking.run_opening import start_run
from attentionvote.tracking.store import connect, experiment_id

EXPERIMENTS = ("rod", "grids")


@pytest.fixture(scope="session")
def store(request, tmp_path_factory):
    """An SQLite file; parametrised indirectly, another kind.

    The experiments are made elsewhere, because a PostgreSQL's artefacts lie below the working directory then.
    """
    uri = request.getfixturevalue("make_session_database")(getattr(request, "param", "sqlite"))
    client = connect(uri)
    with contextlib.chdir(tmp_path_factory.mktemp("artefacts")):
        for name in EXPERIMENTS:
            experiment_id(client, uri, name)
    return uri


@pytest.fixture
def run(store):
    run = start_run(store, "rod", name="test", system_interval_s=0)
    yield run
    run.close("FINISHED")


@pytest.fixture
def guarded(postgresql, monkeypatch, tmp_path):
    """URI of an empty PostgreSQL database with the password of its owner, ``swordfish/7``; a working directory too."""
    monkeypatch.chdir(tmp_path)
    name = postgresql.create()
    postgresql.run("create role guarded login password 'swordfish/7'")
    postgresql.run(f"alter database {name} owner to guarded")
    yield postgresql.uri(name, "guarded:swordfish%2F7")
    postgresql.drop(name)
    postgresql.run("drop role guarded")
