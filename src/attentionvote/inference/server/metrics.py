"""The cell's measurements: Prometheus metrics in a registry of the server's own."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from typing import Literal, get_args

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, disable_created_metrics, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from attentionvote.inference.answer import REASONS
from attentionvote.inference.fetching.reference import RegistryVersion

OUTCOMES = ("ok", "abstained", "rejected", "unauthorized", "overloaded", "unavailable", "deadline", "gone", "failed")
STAGES = ("receive", "parse", "queue", "estimate", "total")
SECONDS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5, 0.75, 1.0, 2.0, 5.0, 10.0)
DETECTIONS = (0, 1, 2, 3, 5, 8, 12, 20, 30, 50)
RELOADS = ("loaded", "refused", "failed", "last_known_good")
LOSSES = ("deadline", "memory", "crashed")
Closed = Literal["silent", "head", "handshake", "answer", "chunks"]
CLOSED: tuple[Closed, ...] = get_args(Closed)
POLLS = ("answered", "away", "refused", "failed")


class Metrics:
    """Every metric of the server. What can be counted starts at 0, so that a rate has a beginning."""

    def __init__(self) -> None:
        disable_created_metrics()  # a time beside every counter says nothing here and doubles the page
        self.registry = CollectorRegistry()
        prefix = "attentionvote_"
        self.requests = Counter(
            prefix + "requests", "Requests for poses by outcome", ["outcome"], registry=self.registry
        )
        self.seconds = Histogram(
            prefix + "request_seconds", "Seconds of a request by stage", ["stage"], buckets=SECONDS,
            registry=self.registry,
        )  # fmt: skip
        self.waiting = Gauge(
            prefix + "queue_depth", "Requests admitted and not yet answered, the running one included",
            registry=self.registry,
        )  # fmt: skip
        self.abstentions = Counter(
            prefix + "abstentions", "Answers without poses by reason", ["reason"], registry=self.registry
        )
        self.detections = Histogram(
            prefix + "detections", "Poses in an answer", buckets=DETECTIONS, registry=self.registry
        )
        self.withheld = Counter(
            prefix + "poses_withheld", "Poses that could not be where the scan was measured", registry=self.registry
        )
        self.ready = Gauge(
            prefix + "ready", "1 when a tested model serves and one of its workers can answer", registry=self.registry
        )
        self.workers_lost = Counter(
            prefix + "workers_lost", "Worker processes that were ended or ended, by reason", ["reason"],
            registry=self.registry,
        )  # fmt: skip
        self.worker_memory = Gauge(
            prefix + "worker_memory_bytes", "Resident memory of the worker processes", registry=self.registry
        )
        self.model = Gauge(
            prefix + "model_info", "The model that serves", ["part", "version", "digest"], registry=self.registry
        )
        self.reloads = Counter(
            prefix + "reloads", "Attempts to load a bundle by outcome", ["outcome"], registry=self.registry
        )
        self.reload_error = Gauge(
            prefix + "reload_error_info", "Why the bundle at the served path is not the one that serves",
            ["error"], registry=self.registry,
        )  # fmt: skip
        self.reload_failing = Gauge(
            prefix + "reload_failing", "1 while the bundle at the path is not what serves", registry=self.registry
        )
        self.from_last_known_good = Gauge(
            prefix + "serving_last_known_good", "1 while the copy of the last good bundle serves, not the given path",
            registry=self.registry,
        )  # fmt: skip
        self.saved = Gauge(
            prefix + "last_known_good_kept", "1 when the model that serves is also kept on disk for the next start",
            registry=self.registry,
        )  # fmt: skip
        self.registered_as = Gauge(
            prefix + "registry_info", "The registered version that serves", ["model", "version", "digest"],
            registry=self.registry,
        )  # fmt: skip
        self.registry_polls = Counter(
            prefix + "registry_polls", "Questions to the registry by outcome", ["outcome"], registry=self.registry
        )
        self.registry_error = Gauge(
            prefix + "registry_error_info", "Why what the registry names does not serve", ["error"],
            registry=self.registry,
        )  # fmt: skip
        self.registry_failing = Gauge(
            prefix + "registry_failing", "1 while the registry cannot be followed", registry=self.registry
        )
        self.connections = Gauge(prefix + "connections", "Open connections", registry=self.registry)
        self.connections_closed = Counter(
            prefix + "connections_closed", "Connections that the server ended before their client did, by reason",
            ["reason"], registry=self.registry,
        )  # fmt: skip
        self.log_lines_dropped = Counter(
            prefix + "log_lines_dropped", "Log lines that nobody read in time", registry=self.registry
        )
        self.registry.register(_Memory())
        for outcome in OUTCOMES:
            self.requests.labels(outcome)
        for stage in STAGES:
            self.seconds.labels(stage)
        for reason in REASONS:
            self.abstentions.labels(reason)
        for outcome in POLLS:
            self.registry_polls.labels(outcome)
        for loss in LOSSES:
            self.workers_lost.labels(loss)
        for closed in CLOSED:
            self.connections_closed.labels(closed)
        for outcome in RELOADS:
            self.reloads.labels(outcome)

    def serving(self, part: str, version: str, digest: str, *, saved: bool, last_known_good: bool) -> None:
        """Say which model serves from now on."""
        self.model.clear()
        self.model.labels(part, version, digest).set(1)
        self.saved.set(saved)
        self.from_last_known_good.set(last_known_good)

    def reload_problem(self, sentence: str | None) -> None:
        """Say why the bundle at the served path does not serve; None when it does."""
        self.reload_error.clear()
        self.reload_failing.set(sentence is not None)
        if sentence is not None:
            self.reload_error.labels(sentence).set(1)

    def registered(self, version: RegistryVersion | None) -> None:
        """Say which registered version serves from now on; None when it comes from a path."""
        self.registered_as.clear()
        if version is not None:
            self.registered_as.labels(version.name, version.version, version.digest).set(1)

    def registry_problem(self, sentence: str | None) -> None:
        """Say why the registry cannot be followed; None when it can."""
        self.registry_error.clear()
        self.registry_failing.set(sentence is not None)
        if sentence is not None:
            self.registry_error.labels(sentence).set(1)

    def text(self) -> bytes:
        """The exposition in Prometheus' text format."""
        return generate_latest(self.registry)


class _Memory(Collector):
    """The process' peak of resident memory: a leak shows here first."""

    def collect(self) -> Iterator[Metric]:
        metric = GaugeMetricFamily("attentionvote_peak_memory_bytes", "Highest resident memory of the process so far")
        metric.add_metric([], resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0)
        yield metric
