"""``attentionvote health``: is the server ready? For containers and timers, without curl. Exit code 0 or 1."""

from __future__ import annotations

import argparse
import http.client
import json
import ssl
import sys
import urllib.error
import urllib.parse
import urllib.request

from attentionvote.inference.server.access import is_loopback
from attentionvote.inference.server.addresses import running_servers

READY = "/v2/health/ready"
URL = "http://127.0.0.1:8000"
_MOST_BYTES = 64 * 1024


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's arguments."""
    parser.add_argument("--url", help=f"of the server; default: the one that this user runs here, else {URL}")
    parser.add_argument("--timeout-s", type=float, default=3.0, help="longest wait, default 3")


def run(options: argparse.Namespace) -> int:
    """Ask once and say the answer in a sentence.

    Returns:
        The exit code: 0 ready, 1 not ready or not reachable, 2 no usable address.
    """
    url = options.url
    if url is None:
        servers = running_servers()
        if len(servers) > 1:
            sentence = "--url must say which server is asked where several run, got none"
            print(f"health: {sentence}: one of {', '.join(servers)}", file=sys.stderr)
            return 2
        url = servers[0] if servers else URL
    parts = urllib.parse.urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname:
        print(f"health: --url must be http://HOST:PORT or https://HOST:PORT, got {url!r}", file=sys.stderr)
        return 2
    context = None
    if parts.scheme == "https":
        context = ssl.create_default_context()
        # A certificate names the machine to others, not to itself.
        if options.url is None or is_loopback(parts.hostname):
            context.check_hostname = False
            context.verify_mode = ssl.CERT_NONE
    address = f"{parts.scheme}://{parts.netloc}{READY}"
    # No proxy: the question is about this very server.
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}), urllib.request.HTTPSHandler(context=context))
    try:
        with opener.open(address, timeout=options.timeout_s) as response:
            content = json.loads(response.read(_MOST_BYTES))
        origin = content.get("registry")
        registered = f", version {origin['version']} of {origin['name']}" if origin else ""
        print(f"ready: {content['model']} {content['version']}{registered}")
        return 0
    except urllib.error.HTTPError as error:
        print(f"health: not ready ({error.code}): {_sentence(error.read(_MOST_BYTES))}", file=sys.stderr)
    except (OSError, http.client.HTTPException) as error:
        reason = getattr(error, "reason", None) or error
        print(f"health: {address} cannot be reached: {reason}", file=sys.stderr)
    except (ValueError, KeyError, TypeError):
        print(f"health: {address} must be an attentionvote server, got another kind of answer", file=sys.stderr)
    return 1


def _sentence(body: bytes) -> str:
    try:
        return str(json.loads(body)["error"])
    except (ValueError, KeyError, TypeError):
        return "it gave no reason"


def main(arguments: list[str] | None = None) -> int:
    """The verb by itself: ``python -m attentionvote.inference.server.health``."""
    parser = argparse.ArgumentParser(prog="attentionvote health", description="Ask a server whether it is ready.")
    add_arguments(parser)
    return run(parser.parse_args(arguments))


if __name__ == "__main__":
    sys.exit(main())
