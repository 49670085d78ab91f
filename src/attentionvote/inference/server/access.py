"""Access to the server: the API token from a file, and the rule that without one only this machine may."""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import os
import stat
import urllib.parse
from pathlib import Path

from attentionvote.inference.errors import InputError

OPEN_PATHS = ("/v2/health/live", "/v2/health/ready")
SHORTEST_TOKEN = 16
_MOST_BYTES = 16 * 1024


class Tokens:
    """The accepted tokens; only their hashes are kept.

    Args:
        path: a file with one token a line. Two lines serve while a token is exchanged.

    Raises:
        InputError: when the file cannot be read or holds no usable token.
    """

    def __init__(self, path: Path) -> None:
        try:
            with path.open("rb") as file:
                content = file.read(_MOST_BYTES + 1)
                mode = os.fstat(file.fileno()).st_mode
        except OSError as error:
            raise InputError(f"token file {path} must be readable, but: {error.strerror}") from error
        lines = [line.strip() for line in content.splitlines() if line.strip()]
        if not lines or len(content) > _MOST_BYTES:
            raise InputError(
                f"token file {path} must hold one token a line, got {len(lines)} lines of {len(content)} bytes"
            )
        for number, line in enumerate(lines, 1):
            if len(line) < SHORTEST_TOKEN or not all(0x21 <= code <= 0x7E for code in line):
                raise InputError(
                    f"token file {path} must hold tokens of at least {SHORTEST_TOKEN} printable characters without "
                    f"spaces, line {number} is none: make one with `openssl rand -hex 32`"
                )
        self._hashes = [hashlib.sha256(line).digest() for line in lines]
        self.readable_by_others = bool(stat.S_IMODE(mode) & stat.S_IROTH)

    def accept(self, authorization: str | None) -> bool:
        """Whether an ``Authorization`` header carries a token; the time does not depend on how much of it is right."""
        scheme, _, token = (authorization or "").partition(" ")
        digest = hashlib.sha256(token.strip().encode("latin-1", "replace")).digest()
        matches = [hmac.compare_digest(digest, valid) for valid in self._hashes]
        return scheme.lower() == "bearer" and any(matches)


def check_host(host: str, tokens: Tokens | None) -> None:
    """Without a token a server listens to its own machine only.

    Raises:
        InputError: when it would listen to others.
    """
    if tokens is None and not is_loopback(host):
        raise InputError(
            f"--host must be a loopback address such as 127.0.0.1 without --token-file, got {host!r}: "
            "give a token file to listen to other machines"
        )


def is_loopback(host: str) -> bool:
    """Whether a host is this machine's loopback interface: ``localhost``, 127.0.0.0/8 or ::1."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def names_this_machine(host_header: str) -> bool:
    """Whether a ``Host`` header, with or without a port, names the loopback interface."""
    try:
        host = urllib.parse.urlsplit(f"//{host_header}").hostname or ""
    except ValueError:  # half an IPv6 address
        return False
    return is_loopback(host)
