"""The model that serves, the threads that ask its workers, and the exchange of models that no request notices."""

from __future__ import annotations

import logging
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from attentionvote.contract import ModelCard
from attentionvote.inference.answer import DIGEST_LENGTH
from attentionvote.inference.errors import nearest
from attentionvote.inference.fetching.reference import RegistryVersion
from attentionvote.inference.server.json_logs import say
from attentionvote.inference.server.metrics import Metrics
from attentionvote.inference.server.refusal import Refusal, bad_request
from attentionvote.inference.server.worker.workers import Workers

_ASKING = 2  # threads, as many as workers


@dataclass(frozen=True)
class Served:
    """A model that passed its self-test.

    Attributes:
        workers: with the verified bundle.
        saved: whether a copy for the next start is on the disk.
        last_known_good: whether it came from such a copy, not from the given path.
        origin: which registered version it is; None where it came from a path.
    """

    workers: Workers
    saved: bool
    last_known_good: bool
    origin: RegistryVersion | None = None

    @property
    def card(self) -> ModelCard:
        """The model's card."""
        return self.workers.card

    @property
    def name(self) -> str:
        """The model's name for clients: the part's."""
        return self.card.part.name

    @property
    def digest(self) -> str:
        """sha256 of the bundle's manifest."""
        return self.workers.digest

    @property
    def version(self) -> str:
        """The model's version for clients: the first digits of the digest."""
        return self.digest[:DIGEST_LENGTH]


class Serving:
    """The model that serves. All methods are called on the event loop; two threads ask its workers.

    Args:
        metrics: to be told about the model.
    """

    def __init__(self, metrics: Metrics) -> None:
        self.current: Served | None = None
        self.waits_for = "no bundle was loaded yet"
        self._metrics = metrics
        self._threads = ThreadPoolExecutor(_ASKING, thread_name_prefix="jobs")
        metrics.ready.set_function(lambda: float(self.available))
        metrics.worker_memory.set_function(self._worker_memory)

    def model(self, name: str | None = None, version: str | None = None) -> Served:
        """The model that serves, when it is the one asked for.

        Raises:
            Refusal: 503 when there is none yet, 404 when another name or version serves.
        """
        served = self.current
        if served is None:
            raise Refusal(503, f"no model is ready: {self.waits_for}", "unavailable", {"Retry-After": "2"})
        if name is not None and name != served.name:
            hint = nearest(name, [served.name])
            raise bad_request(f"model must be {served.name!r}, which is served here, got {name[:80]!r}{hint}", 404)
        if version is not None and version != served.version:
            raise bad_request(
                f"version of model {served.name!r} must be {served.version!r}, which is served here, "
                f"got {version[:80]!r}: leave the version out for whatever is served",
                404,
            )
        return served

    @property
    def available(self) -> bool:
        """Whether a request would be worked on: a model serves, and one of its workers is loaded and not stuck."""
        return self.current is not None and self.current.workers.available

    def ready(self, name: str | None = None, version: str | None = None) -> Served:
        """The model that serves, when it is the one asked for and a worker can answer at once.

        Raises:
            Refusal: 503 when there is none, or no worker; 404 when another name or version serves.
        """
        served = self.model(name, version)
        if not served.workers.available:
            raise Refusal(503, "no worker is ready: a lost one is being replaced", "unavailable", {"Retry-After": "2"})
        return served

    def submit(self, work: Any, *arguments: Any) -> Future[Any]:
        """Queue work for the threads that ask the workers."""
        return self._threads.submit(work, *arguments)

    def swap(self, served: Served) -> None:
        """Let another model serve. Requests that were queued before end on the old one, which is closed after them."""
        old, self.current = self.current, served
        self._metrics.serving(
            served.name, served.version, served.digest, saved=served.saved, last_known_good=served.last_known_good
        )
        self._metrics.registered(served.origin)
        say(
            "model", f"{served.name} {served.version} serves",
            part=served.name, version=served.version, digest=served.digest,
            kept=served.saved, last_known_good=served.last_known_good, before=old.version if old else None,
            registry=str(served.origin) if served.origin else None,
            level=logging.WARNING if served.last_known_good or not served.saved else logging.INFO,
        )  # fmt: skip
        if old is not None and old.workers is not served.workers:
            old.workers.retire()

    def close(self) -> None:
        """Take no more work; what is queued or runs is dropped."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        if self.current is not None:
            self.current.workers.close()

    def _worker_memory(self) -> float:
        return 0.0 if self.current is None else float(self.current.workers.memory_bytes)
