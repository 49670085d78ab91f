"""Load a bundle's server: ``make bench-serve OBJECT=X``, or ``python pipelines/bench_serve.py BUNDLE [--seconds 60]``.

Starts the cell's server on a free loopback port and lets a few clients send the bundle's golden clouds as fast as
they are answered. Every answer is compared with what an estimator of this process finds in the same cloud, after that
one has reproduced the golden poses. Clients come back when the server has no place for them (503), so those are
counted and nothing is lost by them.

Standard output: one JSON object. Exit codes: 0; 1 when an answer was wrong or missing; 2 for impossible arguments.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from attentionvote.inference import BundleError, keys_folder
from attentionvote.inference.bundles.signature import PUBLIC_NAME
from attentionvote.workflows.speed.serving import bench, expectations, table


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="make bench-serve", description="Load a bundle's server and check it.")
    parser.add_argument("bundle", type=Path, help="the bundle's folder")
    parser.add_argument("--seconds", type=float, default=60.0, help="how long, default 60")
    parser.add_argument("--clients", type=int, default=4, help="at the same time, default 4")
    parser.add_argument("--queue", type=int, default=2, help="of the server, default 2")
    parser.add_argument("--key", type=Path, help=f"public key of the bundle, default {PUBLIC_NAME} in the keys' folder")
    options = parser.parse_args(arguments)
    if not (0 < options.seconds <= 86_400 and 1 <= options.clients <= 256 and options.queue >= 0):
        print("bench-serve: seconds, clients and queue must be positive numbers of a sensible size", file=sys.stderr)
        return 2
    key = options.key if options.key is not None else keys_folder() / PUBLIC_NAME
    try:
        expected = expectations(options.bundle, key)
        result = bench(options.bundle, key, expected, options.seconds, options.clients, options.queue)
    except (BundleError, OSError) as error:
        print(f"bench-serve: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("bench-serve: interrupted", file=sys.stderr)
        return 130
    print(table(result), file=sys.stderr)
    print(json.dumps(result))
    return int(result["wrong"] > 0 or result["lost"] > 0 or result["answered"] == 0)


if __name__ == "__main__":
    sys.exit(main())
