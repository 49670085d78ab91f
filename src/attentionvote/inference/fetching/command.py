"""``attentionvote fetch models:/NAME@ALIAS``: fetch a bundle from the registry once, verify it, say where it is.

For the build of an image, for a stick that is carried to a cell without a network, and to prepare a cell's first start.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from attentionvote.inference.bundles.signature import PUBLIC_NAME, trusted_key
from attentionvote.inference.errors import BundleError
from attentionvote.inference.fetching import access as registry_access
from attentionvote.inference.fetching.bundles import DIGITS, FetchedBundles
from attentionvote.inference.fetching.reference import parse_reference
from attentionvote.inference.fetching.registry import Registry


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's arguments."""
    parser.add_argument("reference", metavar="MODEL", help="models:/NAME@ALIAS or models:/NAME/VERSION")
    parser.add_argument(
        "--to", type=Path, metavar="FOLDER", default=Path("bundles"), help="gets the bundle and a link `latest` to it"
    )
    parser.add_argument(
        "--key", type=Path, metavar="FILE", help=f"public key that must have signed it; default: {PUBLIC_NAME}"
    )
    registry_access.add_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Fetch, and print the bundle's folder on stdout.

    Returns:
        The exit code 0.

    Raises:
        InputError: the command is at fault.
        BundleError: the bundle, the registry or the disk is.
    """
    reference = parse_reference(options.reference)
    access = registry_access.access(options)
    key = trusted_key(options.key)
    try:
        bundles = FetchedBundles(options.to, reference, key)
        registry = Registry(access)
        version = registry.resolve(reference)
        folder, fetched = bundles.take(registry, version)
    except OSError as error:
        raise BundleError(f"{options.to} must take the bundle, but it cannot be written: {error.strerror}") from error
    state = "fetched and verified" if fetched else "already there and verified"
    print(f"attentionvote: {reference} is {version}, bundle {version.digest[:DIGITS]}, {state}", file=sys.stderr)
    print(folder)
    return 0
