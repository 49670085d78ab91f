#!/usr/bin/env python3
"""Make a user of the team's MLflow server, with a password of his own in a file.

    docker/team_user.py person NAME             reads and writes every experiment and every model
    docker/team_user.py cell NAME PART ...      reads the registered models of those parts, and nothing else

Any Python from 3.8 does. The administrator's password is read from FOLDER/admin_password, one line ``user:password``
goes to FOLDER/NAME.auth: what `attentionvote serve --registry-auth-file` wants. A user who exists keeps his password
and gets the rights of the call. Exit codes: 0 done, 1 the server refuses or is away, 2 the call is wrong.
"""

import argparse
import base64
import json
import os
import re
import secrets
import sys
import urllib.error
import urllib.request
from pathlib import Path

CREATE = "/api/2.0/mlflow/users/create"
GRANT, REVOKE = "/api/3.0/mlflow/users/permissions/grant", "/api/3.0/mlflow/users/permissions/revoke"


def ask(server: str, password: str, path: str, content: "dict[str, str]") -> None:
    """One request of the administrator's.

    Raises:
        OSError: the server refuses, with its words, or is away.
    """
    request = urllib.request.Request(server + path, json.dumps(content).encode(), {"Content-Type": "application/json"})
    request.add_header("Authorization", "Basic " + base64.b64encode(f"admin:{password}".encode()).decode())
    try:
        with urllib.request.urlopen(request, timeout=30):
            pass
    except urllib.error.HTTPError as error:
        raise OSError(f"HTTP {error.code}: {error.read(2000).decode(errors='replace').strip()}") from error


def grants(kind: str, parts: "list[str]") -> "list[tuple[str, str, str]]":
    """Resource, its name and the permission, of a kind of user."""
    if kind == "person":
        return [("experiment", "*", "EDIT"), ("registered_model", "*", "EDIT")]
    # Anybody may make experiments and models of new names (MLflow 3.17); experiments can be denied to a cell, models
    # cannot without those that it reads.
    return [("experiment", "*", "DENY"), *(("registered_model", f"attentionvote-{part}", "READ") for part in parts)]


def make_user(server: str, folder: Path, kind: str, name: str, parts: "list[str]") -> str:
    """Make the user, or give one who exists the rights; a sentence for the terminal."""
    admin = (folder / "admin_password").read_text(encoding="utf-8").strip()
    file, password = folder / f"{name}.auth", secrets.token_hex(24)
    try:
        ask(server, admin, CREATE, {"username": name, "password": password})
        with open(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w", encoding="utf-8") as output:
            output.write(f"{name}:{password}\n")
        said = f"user {name} was made, user and password are in {file}"
    except OSError as error:
        if "RESOURCE_ALREADY_EXISTS" not in str(error):
            raise
        said = f"user {name} existed and keeps his password"
    for resource, of, permission in grants(kind, parts):
        right = {"username": name, "resource_type": resource, "resource_id": of}
        try:
            ask(server, admin, GRANT, {**right, "permission": permission})
        except OSError as error:
            if "RESOURCE_ALREADY_EXISTS" not in str(error):
                raise
            ask(server, admin, REVOKE, right)  # it may be of another level
            ask(server, admin, GRANT, {**right, "permission": permission})
    return f"{said}; rights: " + ", ".join(f"{level} {what} {of}" for what, of, level in grants(kind, parts))


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="team_user.py", description="Make a user of the team's MLflow server.")
    parser.add_argument("kind", choices=["person", "cell"])
    parser.add_argument("name")
    parser.add_argument("parts", nargs="*", metavar="PART", help="of a cell: the parts whose models it may read")
    parser.add_argument("--server", default="http://127.0.0.1:5000")
    parser.add_argument("--secrets", type=Path, default=Path(__file__).parent / "team", metavar="FOLDER")
    options = parser.parse_args()
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", options.name):
        parser.error(f"a name must consist of letters, digits, dots and dashes, got {options.name!r}")
    if (options.kind == "cell") != bool(options.parts):
        parser.error("a cell must be given at least one PART, a person none")
    try:
        print(make_user(options.server.rstrip("/"), options.secrets, options.kind, options.name, options.parts))
    except (OSError, ValueError) as error:
        print(f"team_user.py: {options.server} must take the administrator's requests, but: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
