#!/usr/bin/env python3
"""Make a user of the team's MLflow server, with a password of his own in a file.

    docker/team_user.py person NAME             reads and writes every experiment and every model
    docker/team_user.py cell NAME PART ...      reads the registered models of those parts, and nothing else

Any Python from 3.8 does. The administrator's password is read from FOLDER/admin_password, one line ``user:password``
goes to FOLDER/NAME.auth: what `attentionvote serve --registry-auth-file` wants. A user who exists keeps his password
and gets the rights of the call and no others; only what a person made stays his, and roles that he was given are left
alone. Exit codes: 0 done, 1 the server refuses or is away, 2 the call is wrong.
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
from typing import Any

CREATE = "/api/2.0/mlflow/users/create"
CURRENT, LIST = "/api/3.0/mlflow/users/current/permissions", "/api/3.0/mlflow/users/permissions/list"
GRANT, REVOKE = "/api/3.0/mlflow/users/permissions/grant", "/api/3.0/mlflow/users/permissions/revoke"


def ask(server: str, login: str, path: str, content: "dict[str, str] | None" = None) -> "dict[str, Any]":
    """The answer to one request of ``user:password``: a POST of the content, a GET without one.

    Raises:
        OSError: the server refuses, with its words, or is away.
        ValueError: it answers no JSON.
    """
    data = None if content is None else json.dumps(content).encode()
    request = urllib.request.Request(server + path, data, {"Content-Type": "application/json"})
    request.add_header("Authorization", "Basic " + base64.b64encode(login.encode()).decode())
    try:
        with urllib.request.urlopen(request, timeout=30) as reply:
            answer = json.loads(reply.read() or b"{}")
            return answer if isinstance(answer, dict) else {}
    except urllib.error.HTTPError as error:
        raise OSError(f"HTTP {error.code}: {error.read(2000).decode(errors='replace').strip()}") from error


def grants(kind: str, parts: "list[str]") -> "list[tuple[str, str, str]]":
    """Resource, its name and the permission, of a kind of user."""
    if kind == "person":
        return [("experiment", "*", "EDIT"), ("registered_model", "*", "EDIT")]
    # Anybody may make experiments and models of new names (MLflow 3.17); experiments can be denied to a cell, models
    # cannot without those that it reads.
    return [("experiment", "*", "DENY"), *(("registered_model", f"attentionvote-{part}", "READ") for part in parts)]


def make_login(server: str, admin: str, file: Path, name: str) -> str:
    """Make the user and his file, or leave one who exists as he is; a sentence for the terminal.

    The password is on the disk before the server knows it, and a killed run's is taken up again.
    """
    pending = file.with_name(file.name + ".new")
    login = pending.read_text(encoding="utf-8").strip() if pending.exists() else ""
    if not re.fullmatch(re.escape(name) + ":[0-9a-f]{48}", login):
        login = f"{name}:{secrets.token_hex(24)}"
        with open(os.open(pending, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w", encoding="utf-8") as output:
            os.fchmod(output.fileno(), 0o600)
            output.write(login + "\n")
            output.flush()
            os.fsync(output.fileno())
    try:
        ask(server, admin, CREATE, {"username": name, "password": login.partition(":")[2]})
    except OSError as error:
        if "RESOURCE_ALREADY_EXISTS" not in str(error):
            raise
        try:
            ask(server, login, CURRENT)  # was it a killed run that made him?
        except OSError as refusal:
            if not str(refusal).startswith("HTTP 401"):
                raise
            pending.unlink()
            if file.exists() and file.stat().st_mode & 0o077:
                file.chmod(0o600)
            return f"user {name} existed and keeps his password"
    os.replace(pending, file)
    return f"user {name} was made, user and password are in {file}"


def make_user(server: str, folder: Path, kind: str, name: str, parts: "list[str]") -> str:
    """Make the user, or give one who exists these rights and no others; a sentence for the terminal."""
    admin = "admin:" + (folder / "admin_password").read_text(encoding="utf-8").strip()
    said = make_login(server, admin, folder / f"{name}.auth", name)
    wanted = {(resource, of): permission for resource, of, permission in grants(kind, parts)}
    for row in ask(server, admin, f"{LIST}?username={name}")["permissions"]:
        key, permission = (row["resource_type"], row["resource_pattern"]), row["permission"]
        if not row["role_name"].startswith("__user_"):
            continue  # of a role that the administrator gave him
        if wanted.get(key) == permission:
            del wanted[key]
        elif kind == "cell" or permission != "MANAGE":  # a person keeps what he made
            ask(server, admin, REVOKE, {"username": name, "resource_type": key[0], "resource_id": key[1]})
    for (resource, of), permission in wanted.items():
        right = {"username": name, "resource_type": resource, "resource_id": of, "permission": permission}
        ask(server, admin, GRANT, right)
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
