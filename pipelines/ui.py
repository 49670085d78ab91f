"""Open the tracked runs in a browser: ``make ui``, or ``python pipelines/ui.py [--store sqlite:///X.db] [--port N]``.

Serves the store on a free loopback port until Ctrl-C or SIGTERM; the server never outlives the script. A store that is
a server already is only named.
Standard output: one JSON object with the address, as soon as it answers.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys

from attentionvote.tracking.server import serve
from attentionvote.tracking.store import is_server, resolve_store, shown


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="make ui", description="Open the tracked runs in a browser.")
    parser.add_argument("--store", help="default: MLFLOW_TRACKING_URI, else outputs/mlflow.db")
    parser.add_argument("--port", type=int, default=0, help="default: a free one")
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        store = resolve_store(options.store)
        if is_server(store):
            print(json.dumps({"url": store, "store": shown(store)}), flush=True)
            return 0
        print(f"starting MLflow on {shown(store)} ...", file=sys.stderr)
        with serve(store, options.port) as server:
            print(f"open {server.url} (Ctrl-C ends it)", file=sys.stderr)
            print(json.dumps({"url": server.url, "store": shown(store)}), flush=True)
            server.process.wait()
            print("error: the MLflow server ended by itself", file=sys.stderr)
            return 1
    except KeyboardInterrupt:
        return 0
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


def _interrupt(*_: object) -> None:
    """End as Ctrl-C does: `kill`, and `make` that was killed, send SIGTERM."""
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
