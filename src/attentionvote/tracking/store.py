"""The store of the runs: choose it, make sure that it exists, connect to it."""

from __future__ import annotations

import contextlib
import difflib
import logging
import os
import re
import urllib.parse
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from attentionvote.files import DiskFull, waiting_lock
from attentionvote.tracking.server_check import CREDENTIALS, check_access, check_health, check_version
from attentionvote.tracking.sqlite_file import (
    check_encoding,
    create_database,
    naming_full_disk,
    sqlite_file,
    sqlite_uri,
    without_stray_folder,
)

if TYPE_CHECKING:
    from mlflow import MlflowClient

DATABASES = ("sqlite", "postgresql", "mysql", "mssql")
SERVERS = ("http", "https")
_DATABASE_PATIENCE_S = 10
# By it MLflow opens an experiment on its runs, charts and models instead of the pages for language models.
KIND = {"mlflow.experimentKind": "custom_model_development"}
_ADVISORY_LOCK = 0x617474766F7465  # "attvote": one number of ours among everybody's locks in that database
# Before the import of MLflow: no telemetry, no chatter; a dead server fails within seconds rather than minutes,
# because our own writers retry in the background anyway. Existing settings of the user win.
ENVIRONMENT = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "DO_NOT_TRACK": "true",
    "MLFLOW_LOGGING_LEVEL": "WARNING",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "30",
    "MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR": "false",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",  # a verb's standard output is one JSON object
}


def resolve_store(store: str | None) -> str:
    """The store's URI: the argument, else ``MLFLOW_TRACKING_URI``, else ``outputs/mlflow.db`` of the working directory.

    Args:
        store: the path of an SQLite file that ends in ``.db``, as it is; ``sqlite:///relative/or/absolute.db``, in
            which ``%``, ``?`` and ``#`` of the path are percent-encoded, as SQLAlchemy reads it; ``http(s)://host:port``
            or a database URI.

    Raises:
        ValueError: the URI has another scheme, with the nearest valid one; it may mean another file than it seems to; a
            server's address holds a password, or a database's holds one that cannot be told from its host.
    """
    store = store or os.environ.get("MLFLOW_TRACKING_URI") or "outputs/mlflow.db"
    if "://" not in store and not store.startswith(("file:", "sqlite:")) and store.endswith(".db"):
        return sqlite_uri(Path(store))
    scheme = store.split(":", 1)[0].split("+", 1)[0] if ":" in store else ""
    if scheme == "sqlite":
        path = re.sub(r"^sqlite(\+\w+)?:///", "", store)
        if path == store or not path:
            raise ValueError(f"an SQLite tracking store must read sqlite:///PATH.db, got {store!r}")
        check_encoding(store, path)
        return sqlite_uri(Path(urllib.parse.unquote(path)))
    if scheme in SERVERS:
        if "@" in store.split("://", 1)[-1].partition("/")[0]:
            raise ValueError(
                f"a tracking server's address must not hold user and password, got {shown(store)!r}: {CREDENTIALS}"
            )
        return store.rstrip("/")
    if scheme in DATABASES:
        if re.match(r"[\w+]+://[^:/?@]*:[^@]*@[^?]*@", store):
            raise ValueError(
                f"the password in a tracking store's address must be percent-encoded (@ is %40), got {shown(store)!r}"
            )
        # SQLAlchemy's own choice is psycopg 3, which nothing here installs.
        return re.sub("^postgresql://", "postgresql+psycopg2://", store)
    if scheme in ("file", ""):
        raise ValueError(
            f"tracking store must be an SQLite file or a server, because MLflow no longer writes folders; "
            f"got {shown(store)!r}, nearest: 'sqlite:///outputs/mlflow.db'"
        )
    choices = [*DATABASES, *SERVERS]
    near = difflib.get_close_matches(scheme, choices, 1, 0.0)[0]
    raise ValueError(
        f"tracking store must start with one of {', '.join(choices)}, got {shown(store)!r}, nearest: '{near}://'"
    )


def shown(store: str) -> str:
    """The store's URI as people and logs may see it: without its password; a server's without its user too."""
    store = re.sub(r"(?i)^(https?://)[^/?#]*@", r"\1***@", store)
    store = re.sub(r"^([\w+.-]+://[^:/?@]*):.*@", r"\1:***@", store)
    return re.sub(r"(?i)([?&][a-z]*(?:password|secret)=)[^&]*", r"\1***", store)


def has_password(store: str) -> bool:
    """Whether the URI holds a password in clear text."""
    return shown(store) != store


def is_server(uri: str) -> bool:
    """Whether the store is reached over HTTP (then the server decides where artefacts go)."""
    return uri.split(":", 1)[0] in SERVERS


def artifact_root(uri: str) -> Path | None:
    """Folder of the artefacts of a store on this machine, None for a server."""
    if is_server(uri):
        return None
    if (file := sqlite_file(uri)) is not None:
        return file.parent / "mlartifacts"
    return Path("outputs/mlartifacts").absolute()


@contextlib.contextmanager
def exclusive(uri: str) -> Iterator[None]:
    """One process at a time at a store whose first touch by MLflow is not safe for several; not re-entrant.

    An SQLite file is held by a lock beside it, PostgreSQL by a lock of its own, which it releases when a process or
    its machine dies. A server and other databases are not held.

    Raises:
        Exception: SQLAlchemy's, when PostgreSQL cannot be reached.
    """
    if (file := sqlite_file(uri)) is not None:
        with waiting_lock(file.with_name(file.name + ".lock")):
            yield
    elif uri.startswith("postgresql"):
        from sqlalchemy import create_engine, text
        from sqlalchemy.pool import NullPool

        engine = create_engine(uri, poolclass=NullPool, connect_args={"connect_timeout": _DATABASE_PATIENCE_S})
        # Of a transaction rather than a session: it also holds behind a pooler such as PgBouncer.
        with engine.begin() as connection:
            connection.execute(text("select pg_advisory_xact_lock(:key)"), {"key": _ADVISORY_LOCK})
            yield
    else:
        yield


def quiet_environment() -> None:
    """Set MLflow's switches that must be set before its import."""
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)


def connect(uri: str) -> MlflowClient:
    """A client of the store; creates a database's tables, safely when several processes do so at once.

    Raises:
        ConnectionError: a server does not answer, wants other credentials than it was given, or is too old.
        DiskFull: a database on this machine has no room.
        ValueError: the store cannot be used (for example tables of another MLflow version).
    """
    if is_server(uri):
        check_health(uri)
    quiet_environment()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # MLflow's dependencies deprecate each other at import
        from mlflow import MlflowClient
        from mlflow.exceptions import MlflowException
    # One sentence of ours says that a server is away; urllib3 and alembic would add a page.
    for name in ("urllib3.connectionpool", "alembic"):
        logging.getLogger(name).setLevel(logging.ERROR)
    try:
        with exclusive(uri), without_stray_folder(uri), warnings.catch_warnings(), naming_full_disk(uri):
            warnings.simplefilter("ignore")  # MLflow's tables use what SQLAlchemy deprecates
            create_database(uri)
            client = MlflowClient(uri, registry_uri=uri)
    except MlflowException as error:
        sentence = str(error).strip().splitlines()[0]
        hint = f"; try `mlflow db upgrade {shown(uri)}`" if "schema" in sentence else ""
        raise ValueError(f"tracking store {shown(uri)} cannot be used: {sentence}{hint}") from error
    except DiskFull:
        raise
    except Exception as error:  # SQLAlchemy's, for what is no database, is away or lets us not in
        sentence = str(error).strip().splitlines()[0]
        raise ValueError(f"tracking store {shown(uri)} cannot be opened: {sentence}") from error
    if is_server(uri):
        check_access(client, uri)
        check_version(uri)
    return client


def experiment_id(client: MlflowClient, uri: str, name: str) -> str:
    """Id of the experiment, created when new and restored when it had been deleted in the UI.

    Raises:
        PermissionError: a server lets this user not write to it.
    """
    from mlflow.exceptions import MlflowException

    try:
        with exclusive(uri), naming_full_disk(uri):
            return _ensured_experiment(client, uri, name)
    except MlflowException as error:
        if error.get_http_status_code() != 403:
            raise
        raise PermissionError(
            f"tracking server {shown(uri)} must let this user write to experiment {name!r}, it does not (HTTP 403): "
            "its administrator grants EDIT on it"
        ) from error


def _ensured_experiment(client: MlflowClient, uri: str, name: str) -> str:
    from mlflow.exceptions import MlflowException

    root = artifact_root(uri)
    experiment = client.get_experiment_by_name(name)
    if experiment is None:
        try:
            return client.create_experiment(name, artifact_location=root.as_uri() if root else None, tags=KIND)
        except MlflowException:  # somebody else was faster (a server has no lock of ours)
            experiment = client.get_experiment_by_name(name)
            if experiment is None:
                raise
    if experiment.lifecycle_stage == "deleted":
        client.restore_experiment(experiment.experiment_id)
    for tag, kind in KIND.items():
        if tag not in experiment.tags:
            client.set_experiment_tag(experiment.experiment_id, tag, kind)
    return experiment.experiment_id
