"""``attentionvote serve BUNDLE|MODEL``: checks what it was given, serves, and ends in order on a signal."""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import logging
import os
import socket
import ssl
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import uvicorn

from attentionvote.inference.bundles.bundle import Bundle
from attentionvote.inference.bundles.signature import PUBLIC_NAME, trusted_key
from attentionvote.inference.cell import cell_bytes
from attentionvote.inference.errors import BundleError, InputError
from attentionvote.inference.fetching import access as registry_access
from attentionvote.inference.fetching.bundles import FetchedBundles
from attentionvote.inference.scans.limits import MOST_POINTS
from attentionvote.inference.server.access import Tokens, check_host, is_loopback
from attentionvote.inference.server.addresses import Announcement, local_url
from attentionvote.inference.server.admission import Gate
from attentionvote.inference.server.answering import Answering, Limits
from attentionvote.inference.server.application import application
from attentionvote.inference.server.json_logs import configure, say
from attentionvote.inference.server.metrics import Metrics
from attentionvote.inference.server.model.bundle_loading import BundleLoader
from attentionvote.inference.server.model.last_known_good import STATE_VARIABLE, LastKnownGood, default_state
from attentionvote.inference.server.model.serving import Serving
from attentionvote.inference.server.model.source import Source, source_of
from attentionvote.inference.server.network.book import ConnectionBook, connection_limit, raise_handle_limit
from attentionvote.inference.server.network.listening import CellServer
from attentionvote.inference.server.reception import MOST_AT_ONCE
from attentionvote.inference.server.worker.process import WorkerSettings
from attentionvote.inference.server.worker.workers import Workers

PORT = 8000
CLEAR_TOKENS = "tokens cross the network unencrypted: give --tls-cert and --tls-key, or put TLS in front"
# How long requests may take to end after SIGTERM, and threads after that: docker kills after 10 seconds.
_DRAIN_S, _THREADS_S = 6, 1.5
_BACKLOG = 256
_KEEP_ALIVE_S = 75
_MEBIBYTE = 1024 * 1024
_MAX_DEADLINE_MS = 10_000.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's arguments."""
    add = parser.add_argument
    add(
        "bundle",
        help="a bundle's folder, or a link to one: another bundle there is taken up while serving; or "
        "models:/NAME@ALIAS in a registry, which is followed, or models:/NAME/VERSION, which is pinned",
    )
    add("--key", type=Path, help=f"public key that must have signed it (default: {PUBLIC_NAME} in the keys' folder)")
    add("--host", default="127.0.0.1", help="address to listen on; others than loopback need --token-file")
    add("--port", type=int, default=PORT, help=f"default {PORT}; 0 picks a free one")
    add("--token-file", type=Path, help="file with one API token a line, sent as `Authorization: Bearer`")
    add("--tls-cert", type=Path, help="certificate chain (PEM); with --tls-key")
    add("--tls-key", type=Path, help="its private key (PEM)")
    add("--cell", type=Path, help="cell file with the camera of depth images and the bin to crop to")
    add("--state", type=Path, help=f"folder of the last known good copies (default: below ${STATE_VARIABLE})")
    add("--threads", type=int, default=1, help="processor threads of an estimate, default 1")
    add("--queue", type=int, default=2, help="requests that may wait beside the running one, default 2")
    add("--deadline-ms", type=float, default=2000.0, help="of requests that name none, default 2000")
    add("--max-deadline-ms", type=float, help="longest that a request may name, default 10000 or --deadline-ms")
    add("--max-points", type=int, default=MOST_POINTS, help=f"measured points of a scan, default {MOST_POINTS}")
    add("--job-memory-mb", type=float, default=768.0, help="memory of one request's work in MiB, default 768")
    add("--self-test-s", type=float, default=60.0, help="seconds for loading and testing a bundle, default 60")
    add("--max-body-mb", type=float, default=64.0, help="largest request body in MiB, default 64")
    add("--poll-s", type=float, default=2.0, help="seconds between two looks at the bundle's path, default 2")
    registry_access.add_arguments(parser)
    add("--registry-poll-s", type=float, default=10.0, help="seconds between two questions to the registry, default 10")


def run(options: argparse.Namespace) -> int:
    """Serve until SIGTERM, SIGHUP or Ctrl-C.

    Prints one JSON object with the address on stdout as soon as it listens.

    Returns:
        The exit code: 0 after an orderly end, 2 when the options cannot work, 1 when the address cannot be had.
    """
    try:
        settings = _checked(options)
    except (InputError, BundleError) as error:
        print(f"serve: {error}", file=sys.stderr)
        return 2
    configure().dropped = settings.metrics.log_lines_dropped.inc
    try:
        listener = _listen(options.host, options.port)
    except OSError as error:
        print(
            f"serve: {options.host} port {options.port} must be free to listen on, but: {error.strerror}",
            file=sys.stderr,
        )
        return 1
    _serve(options, settings, listener)
    return 0


@dataclass(frozen=True)
class _Settings:
    """What the options came to; ``problem`` is why nothing can be kept for the next start."""

    problem: str
    source: Source
    bundles: FetchedBundles | None
    loader: BundleLoader
    metrics: Metrics
    tokens: Tokens | None
    tls: bool


def _checked(options: argparse.Namespace) -> _Settings:
    """Everything that can be wrong with the options, before any work.

    Raises:
        InputError, BundleError: with one sentence.
    """
    _check_range("--port", options.port, 0, 65535)
    _check_range("--threads", options.threads, 1, 1024)
    _check_range("--queue", options.queue, 0, 1000)
    if options.max_deadline_ms is None:
        options.max_deadline_ms = max(_MAX_DEADLINE_MS, options.deadline_ms)
    _check_range("--max-deadline-ms", options.max_deadline_ms, 1, 3_600_000)
    _check_range("--deadline-ms", options.deadline_ms, 1, options.max_deadline_ms)
    _check_range("--max-points", options.max_points, 1000, 100_000_000)
    _check_range("--job-memory-mb", options.job_memory_mb, 64, 65_536)
    _check_range("--self-test-s", options.self_test_s, 1, 3600)
    _check_range("--max-body-mb", options.max_body_mb, 0.001, 1024)
    _check_range("--poll-s", options.poll_s, 0.05, 3600)
    _check_range("--registry-poll-s", options.registry_poll_s, 0.05, 3600)
    source = source_of(options)
    tokens = Tokens(options.token_file) if options.token_file is not None else None
    check_host(options.host, tokens)
    if (options.tls_cert is None) != (options.tls_key is None):
        raise InputError("--tls-cert and --tls-key must be given together, got one of them")
    if options.tls_cert is not None:
        try:
            # An encrypted key would ask for its password on a terminal; an empty answer makes it an error.
            ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(options.tls_cert, options.tls_key, password=str)
        except (OSError, ValueError) as error:  # ssl's own errors are OSErrors
            raise InputError(
                f"--tls-cert and --tls-key must be a PEM certificate and its key, but they cannot be loaded: {error}"
            ) from error
    cell = cell_bytes(options.cell) if options.cell is not None else b""
    trusted = trusted_key(options.key)
    state = options.state if options.state is not None else default_state(source.name)
    store, problem = None, ""
    try:
        store = LastKnownGood(state)
    except OSError as error:  # a cell with a read-only disk still serves
        problem = (
            f"nothing can be kept for the next start: the state folder {state} cannot be written ({error.strerror})"
        )
    bundles = source.bundles(state, trusted)

    metrics = Metrics()
    memory = int(options.job_memory_mb * _MEBIBYTE)
    workers = WorkerSettings(options.threads, cell, options.max_points, memory, options.self_test_s)

    def start_workers(bundle: Bundle, polite: bool) -> Workers:
        return Workers(bundle, workers, polite=polite, lost=lambda reason: metrics.workers_lost.labels(reason).inc())

    loader = BundleLoader(trusted, start_workers, store, None if bundles is None else bundles.origin_of)
    return _Settings(problem, source, bundles, loader, metrics, tokens, options.tls_cert is not None)


def _check_range(name: str, value: float, least: float, most: float) -> None:
    if not least <= value <= most:
        raise InputError(f"{name} must be between {least:g} and {most:g}, got {value:g}")


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # With its protocol named asyncio sends without delay; else a body waits 40 ms until its head is acknowledged.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen(_BACKLOG)
    except OSError:
        listener.close()
        raise
    return listener


def _serve(options: argparse.Namespace, settings: _Settings, listener: socket.socket) -> None:
    version = importlib.metadata.version("attentionvote")
    metrics = settings.metrics
    serving = Serving(metrics)
    polls = options.poll_s, options.registry_poll_s
    watch = settings.source.watch(settings.bundles, settings.loader, serving, metrics, *polls)
    limits = Limits(options.deadline_ms, options.max_deadline_ms, int(options.max_body_mb * _MEBIBYTE))
    answering = Answering(serving, Gate(options.queue, metrics), limits, metrics)
    app = application(answering, watch, metrics, settings.tokens, version)
    scheme = "https" if settings.tls else "http"
    host, port = listener.getsockname()[:2]
    url = f"{scheme}://[{host}]:{port}" if ":" in host else f"{scheme}://{host}:{port}"
    say("start", f"serving {options.bundle} at {url}", version=version, pid=os.getpid(), tls=settings.tls, url=url)
    if settings.loader.store is None:
        say("last_known_good", settings.problem, logging.WARNING)
    if settings.tokens is not None and settings.tokens.readable_by_others:
        say("token", f"{options.token_file} can be read by everybody on this machine: chmod 600 it", logging.WARNING)
    if settings.tokens is not None and not settings.tls and not is_loopback(options.host):
        say("token", CLEAR_TOKENS, logging.WARNING)
    for warning in settings.source.warnings:
        say("registry", warning, logging.WARNING)
    config = uvicorn.Config(
        app, loop="asyncio", http="h11", ws="none", lifespan="on", interface="asgi3",
        log_config=None, access_log=False, server_header=False, proxy_headers=False,
        timeout_keep_alive=_KEEP_ALIVE_S, timeout_graceful_shutdown=_DRAIN_S,
        ssl_certfile=options.tls_cert, ssl_keyfile=options.tls_key,
    )  # fmt: skip
    most = connection_limit(raise_handle_limit(), MOST_AT_ONCE + 1 + options.queue)
    server = CellServer(config, listener, ConnectionBook(most, metrics))
    server.end_on_signals()
    announcement = _announce(local_url(scheme, host, port))
    print(json.dumps({"url": url, "pid": os.getpid()}), flush=True)
    server.run()
    if announcement is not None:
        announcement.withdraw()
    say("end", "no request is open any more")
    _leave(settings.loader.store)


def _announce(url: str) -> Announcement | None:
    """Let `attentionvote health` know the address."""
    try:
        return Announcement(url)
    except OSError as error:
        say("start", f"attentionvote health needs --url {url}: {error.strerror or error}", logging.WARNING)
    return None


def _leave(store: LastKnownGood | None) -> None:
    """End, even when a thread hangs in a network folder: at exit Python would wait for it for ever."""
    until = time.monotonic() + _THREADS_S
    for thread in threading.enumerate():
        if thread is not threading.current_thread() and not thread.daemon:
            thread.join(max(until - time.monotonic(), 0))
            if thread.is_alive():
                say("end", f"the thread {thread.name} does not end and is left", logging.WARNING)
                logging.shutdown()
                os._exit(0)
    if store is not None:
        store.close()
