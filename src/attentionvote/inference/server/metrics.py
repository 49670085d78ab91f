"""The cell's measurements: Prometheus metrics in a registry of the server's own."""

from __future__ import annotations

import resource
from functools import partial
from typing import Literal, get_args

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, disable_created_metrics, generate_latest
from prometheus_client.metrics import MetricWrapperBase

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
        counter = partial(Counter, namespace="attentionvote", registry=self.registry)
        gauge = partial(Gauge, namespace="attentionvote", registry=self.registry)
        histogram = partial(Histogram, namespace="attentionvote", registry=self.registry)
        self.requests = counter("requests", "Requests for poses by outcome", ["outcome"])
        self.seconds = histogram("request_seconds", "Seconds of a request by stage", ["stage"], buckets=SECONDS)
        self.waiting = gauge("queue_depth", "Requests admitted and not yet answered, the running one included")
        self.abstentions = counter("abstentions", "Answers without poses by reason", ["reason"])
        self.detections = histogram("detections", "Poses in an answer", buckets=DETECTIONS)
        self.withheld = counter("poses_withheld", "Poses that could not be where the scan was measured")
        self.ready = gauge("ready", "1 when a tested model serves and one of its workers can answer")
        self.workers_lost = counter("workers_lost", "Worker processes that were ended or ended, by reason", ["reason"])
        self.worker_memory = gauge("worker_memory_bytes", "Resident memory of the worker processes")
        self.model = gauge("model_info", "The model that serves", ["part", "version", "digest"])
        self.reloads = counter("reloads", "Attempts to load a bundle by outcome", ["outcome"])
        self.reload_error = gauge(
            "reload_error_info", "Why the bundle at the served path is not the one that serves", ["error"]
        )
        self.reload_failing = gauge("reload_failing", "1 while the bundle at the path is not what serves")
        self.from_last_known_good = gauge(
            "serving_last_known_good", "1 while the copy of the last good bundle serves, not the given path"
        )
        self.saved = gauge(
            "last_known_good_kept", "1 when the model that serves is also kept on disk for the next start"
        )
        self.registered_as = gauge(
            "registry_info", "The registered version that serves", ["model", "version", "digest"]
        )
        self.registry_polls = counter("registry_polls", "Questions to the registry by outcome", ["outcome"])
        self.registry_error = gauge("registry_error_info", "Why what the registry names does not serve", ["error"])
        self.registry_failing = gauge("registry_failing", "1 while the registry cannot be followed")
        self.connections = gauge("connections", "Open connections")
        self.connections_closed = counter(
            "connections_closed", "Connections that the server ended before their client did, by reason", ["reason"]
        )
        self.log_lines_dropped = counter("log_lines_dropped", "Log lines that nobody read in time")
        # A leak shows here first.
        peak = gauge("peak_memory_bytes", "Highest resident memory of the process so far")
        peak.set_function(lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0)
        labels: dict[MetricWrapperBase, tuple[str, ...]] = {
            self.requests: OUTCOMES,
            self.seconds: STAGES,
            self.abstentions: REASONS,
            self.registry_polls: POLLS,
            self.workers_lost: LOSSES,
            self.connections_closed: CLOSED,
            self.reloads: RELOADS,
        }
        for metric, values in labels.items():
            for value in values:
                metric.labels(value)

    def serving(self, part: str, version: str, digest: str, *, saved: bool, last_known_good: bool) -> None:
        """Say which model serves from now on."""
        self.model.clear()
        self.model.labels(part, version, digest).set(1)
        self.saved.set(saved)
        self.from_last_known_good.set(last_known_good)

    def reload_problem(self, sentence: str | None) -> None:
        """Say why the bundle at the served path does not serve; None when it does."""
        _say_why(self.reload_failing, self.reload_error, sentence)

    def registered(self, version: RegistryVersion | None) -> None:
        """Say which registered version serves from now on; None when it comes from a path."""
        self.registered_as.clear()
        if version is not None:
            self.registered_as.labels(version.name, version.version, version.digest).set(1)

    def registry_problem(self, sentence: str | None) -> None:
        """Say why the registry cannot be followed; None when it can."""
        _say_why(self.registry_failing, self.registry_error, sentence)

    def text(self) -> bytes:
        """The exposition in Prometheus' text format."""
        return generate_latest(self.registry)


def _say_why(failing: Gauge, error: Gauge, sentence: str | None) -> None:
    error.clear()
    failing.set(sentence is not None)
    if sentence is not None:
        error.labels(sentence).set(1)
