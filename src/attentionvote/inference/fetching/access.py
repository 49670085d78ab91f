"""Access to the registry: its address and the credentials, which no message and no address ever shows."""

from __future__ import annotations

import argparse
import base64
import os
import stat
import urllib.parse
from dataclasses import dataclass, field
from pathlib import Path

from attentionvote.inference.errors import InputError

ADDRESS_VARIABLE = "MLFLOW_TRACKING_URI"
USER_VARIABLE, PASSWORD_VARIABLE = "MLFLOW_TRACKING_USERNAME", "MLFLOW_TRACKING_PASSWORD"
_MOST_BYTES = 4096
_REMEDY = f"put them into --registry-auth-file or {USER_VARIABLE} and {PASSWORD_VARIABLE}"


@dataclass(frozen=True)
class Access:
    """How a registry is reached.

    Attributes:
        url: ``http://HOST:PORT`` or ``https://...``, with the path below which it lies, without a slash at its end.
        authorization: the header's value; None when nobody is named.
        readable_by_others: whether everybody on this machine can read the credentials' file.
    """

    url: str
    authorization: str | None = field(default=None, repr=False)
    readable_by_others: bool = False

    @property
    def host(self) -> str:
        """The host's name or address."""
        return urllib.parse.urlsplit(self.url).hostname or ""

    @property
    def open_to_listeners(self) -> bool:
        """Whether a password would cross the network unencrypted."""
        return self.authorization is not None and self.url.startswith("http:")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of a registry."""
    parser.add_argument(
        "--registry", metavar="URL", help=f"MLflow server of models:/ references, default: ${ADDRESS_VARIABLE}"
    )
    parser.add_argument(
        "--registry-auth-file",
        type=Path,
        metavar="FILE",
        help=f"one line user:password, default: ${USER_VARIABLE} and ${PASSWORD_VARIABLE}",
    )


def access(options: argparse.Namespace) -> Access:
    """The access that options and environment name.

    Raises:
        InputError: when there is none, or it cannot be used.
    """
    url = options.registry or os.environ.get(ADDRESS_VARIABLE)
    if not url:
        raise InputError(
            f"a models:/ reference needs its registry, got none: give --registry http://HOST:PORT or set "
            f"{ADDRESS_VARIABLE}"
        )
    address = checked_address(url)
    if options.registry_auth_file is not None:
        return Access(address, *_from_file(options.registry_auth_file))
    user, password = (os.environ.get(name) for name in (USER_VARIABLE, PASSWORD_VARIABLE))
    if not user and not password:
        return Access(address)
    if not user or not password:
        present, missing = (USER_VARIABLE, PASSWORD_VARIABLE) if user else (PASSWORD_VARIABLE, USER_VARIABLE)
        raise InputError(
            f"{USER_VARIABLE} and {PASSWORD_VARIABLE} must be set together, got {present} only: set {missing}"
        )
    return Access(address, _basic(user, password))


def checked_address(url: str) -> str:
    """A registry's address, without a slash at its end.

    Raises:
        InputError: when it is none, or carries credentials, which are never repeated.
    """
    if "@" in url:
        raise InputError(f"the registry's address must not hold credentials, got some before an '@': {_REMEDY}")
    try:
        parts = urllib.parse.urlsplit(url)
        usable = parts.scheme in ("http", "https") and parts.hostname and (parts.port is None or parts.port > 0)
    except ValueError:  # a port that is no number
        usable = False
    if not usable or parts.query or parts.fragment or not url.isascii() or not url.isprintable() or " " in url:
        raise InputError(
            f"the registry must be http://HOST:PORT or https://HOST:PORT, got {url[:200]!r}: a local store is served "
            "by `mlflow server`"
        )
    return url.rstrip("/")


def _from_file(path: Path) -> tuple[str, bool]:
    try:
        with path.open("rb") as file:
            content = file.read(_MOST_BYTES + 1)
            readable_by_others = bool(stat.S_IMODE(os.fstat(file.fileno()).st_mode) & stat.S_IROTH)
    except OSError as error:
        raise InputError(f"--registry-auth-file {path} must be readable, but: {error.strerror}") from error
    lines = content.splitlines()
    try:
        user, colon, password = (lines[0] if len(lines) == 1 else b"").decode("utf-8").partition(":")
    except UnicodeDecodeError:
        user = colon = password = ""
    if not (user and colon and password) or len(content) > _MOST_BYTES or not (user + password).isprintable():
        raise InputError(
            f"--registry-auth-file {path} must hold one line user:password, got {len(lines)} lines of another form"
        )
    return _basic(user, password), readable_by_others


def _basic(user: str, password: str) -> str:
    return "Basic " + base64.b64encode(f"{user}:{password}".encode()).decode("ascii")
