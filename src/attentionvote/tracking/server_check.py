"""What must hold of a tracking server before anything is written to it, and what is said when it goes away."""

from __future__ import annotations

import contextlib
import re
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mlflow import MlflowClient

CREDENTIALS = "set MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD"
OLDEST = 3  # MLflow's first version with models that have figures of their own
_PATIENCE_S = 10


def check_health(uri: str) -> None:
    """Ask a server whether it is there.

    Raises:
        ConnectionError: it is not, or it refuses the address it is asked by.
    """
    try:
        with urllib.request.urlopen(f"{uri}/health", timeout=_PATIENCE_S):
            pass
    except urllib.error.HTTPError as error:
        if error.code == 403:
            raise ConnectionError(
                f"tracking server {uri} refuses its own address (HTTP 403); start it with --allowed-hosts naming it"
            ) from error
        # Any other answer is an answer: a proxy may hide /health.
    except OSError as error:
        reason = getattr(error, "reason", error)
        raise ConnectionError(
            f"tracking server {uri} must answer, got: {reason}; "
            "start it, or unset MLFLOW_TRACKING_URI for the local store"
        ) from error


def check_access(client: MlflowClient, uri: str) -> None:
    """Ask something that only users are told: /health is open to everybody.

    Raises:
        ConnectionError: the server does not know us, or is none of MLflow's.
    """
    from mlflow.exceptions import MlflowException
    from mlflow.utils.credentials import read_mlflow_creds

    try:
        client.search_experiments(max_results=1)
    except MlflowException as error:
        status = error.get_http_status_code()
        if status not in (401, 403):
            sentence = str(error).strip().splitlines()[0]
            raise ConnectionError(f"tracking server {uri} must answer as MLflow does, got: {sentence}") from error
        user = read_mlflow_creds().username
        refusal = f"it refuses those of {user!r}" if user else "it got none"
        raise ConnectionError(
            f"tracking server {uri} must be given user and password, {refusal} (HTTP {status}): {CREDENTIALS}"
        ) from error


def check_version(uri: str) -> None:
    """Ask a server for its version; one that a proxy hides is taken for new enough.

    Raises:
        ConnectionError: it is older than MLflow 3, which would be found out after hours of training.
    """
    from mlflow.exceptions import MlflowException
    from mlflow.utils.credentials import get_default_host_creds
    from mlflow.utils.rest_utils import http_request

    try:
        answer = http_request(get_default_host_creds(uri), "/version", "GET", timeout=_PATIENCE_S)
    except MlflowException:  # it has answered before: not the version's affair
        return
    version = re.fullmatch(r"(\d+)\.\d+\S*", answer.text.strip())
    if answer.status_code == 200 and version is not None and int(version[1]) < OLDEST:
        raise ConnectionError(
            f"the tracking server at {uri} must be MLflow {OLDEST} or newer, got {version[0]}: upgrade it, or unset "
            "MLFLOW_TRACKING_URI for the local store"
        )


@contextlib.contextmanager
def store_failures(where: str) -> Iterator[None]:
    """Say in one sentence what a store raises in the middle of work, when its server dies say.

    Args:
        where: the store as people may see it.

    Raises:
        ConnectionError: instead of what MLflow and its HTTP client raise.
    """
    from mlflow.exceptions import MlflowException
    from requests import RequestException

    try:
        yield
    except (MlflowException, RequestException) as error:
        raise ConnectionError(
            f"the tracking store {where} must answer until the work is done, got: {_reason(error)}; run the same "
            "command again, it goes on from there"
        ) from error


def _reason(error: BaseException) -> str:
    """What is wrong with a connection, without the names of classes and pools around it."""
    text = str(error).strip().partition("\n")[0]
    words = re.search(r"\[Errno -?\d+\] ([^'\")]+)", text) or re.search(r"([Rr]ead timed out|timed out)", text)
    return words[1] if words else text[:200]
