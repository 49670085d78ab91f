"""What serves: by name and version, and how it is exchanged."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from attentionvote.inference.bundles.bundle import load_bundle
from attentionvote.inference.server.deadline import Deadline
from attentionvote.inference.server.metrics import Metrics
from attentionvote.inference.server.model.serving import Served, Serving
from attentionvote.inference.server.refusal import Refusal
from attentionvote.inference.server.worker.channel import SharedContent
from attentionvote.inference.server.worker.process import WorkerSettings
from attentionvote.inference.server.worker.workers import Workers


@pytest.fixture
def serving() -> Iterator[Serving]:
    """Without a model."""
    made = Serving(Metrics())
    yield made
    made.close()


def estimate(workers: Workers, body: bytes) -> dict[str, Any]:
    """The answer to a file, as plain data."""
    with SharedContent.of(body) as content:
        answer = workers.ask({"kind": "file"}, content, Deadline(20.0))
    assert answer is not None
    return dict(json.loads(bytes(answer.content)))


def test_the_old_one_is_closed_after_its_last_request(
    serving: Serving, make_bundle: Callable[..., Path], trusted_key: Path, make_cloud: Callable[..., Any], npy: Any
) -> None:
    old = Workers(load_bundle(make_bundle("old"), trusted_key), WorkerSettings())
    other = make_bundle("new", graph={"heat": (9.0, 6.0, 3.0, 1.0)})
    new = Workers(load_bundle(other, trusted_key), WorkerSettings())
    body, go_on = npy(make_cloud()), threading.Event()
    serving.swap(Served(old, saved=True, last_known_good=False))

    def slow() -> Any:
        assert go_on.wait(20)
        return estimate(old, body)

    for _ in range(2):
        old.hold()
    running, waiting = serving.submit(slow), serving.submit(slow)
    serving.swap(Served(new, saved=True, last_known_good=False))
    assert serving.model().workers is new
    go_on.set()
    assert len(running.result(20)["poses"]) == 2
    old.release()
    assert waiting.result(20)["model"] == old.digest[:12]
    assert old.available
    old.release()
    assert not old.available
    with pytest.raises(RuntimeError, match="closed"):
        estimate(old, body)
    assert serving.available
    assert len(estimate(new, body)["poses"]) == 3


def test_what_only_changes_its_facts_is_not_closed(
    serving: Serving, bundle_folder: Path, trusted_key: Path, make_cloud: Callable[..., Any], npy: Any
) -> None:
    workers = Workers(load_bundle(bundle_folder, trusted_key), WorkerSettings())
    serving.swap(Served(workers, saved=False, last_known_good=False))
    serving.swap(Served(workers, saved=True, last_known_good=False))
    serving.submit(int).result(20)
    assert len(estimate(workers, npy(make_cloud()))["poses"]) == 2


def test_a_model_is_the_one_asked_for_or_refused(serving: Serving, bundle_folder: Path, trusted_key: Path) -> None:
    serving.waits_for = "the disk is empty"
    with pytest.raises(Refusal, match="no model is ready: the disk is empty") as caught:
        serving.model()
    assert (caught.value.status, caught.value.headers) == (503, {"Retry-After": "2"})
    served = Served(
        Workers(load_bundle(bundle_folder, trusted_key), WorkerSettings()), saved=True, last_known_good=False
    )
    serving.swap(served)
    for name, version in ((None, None), ("bracket", None), ("bracket", served.version), (None, served.version)):
        assert serving.model(name, version) is served
    for name, version in (("Bracket", None), ("", None), ("bracket", ""), ("bracket", served.digest)):
        with pytest.raises(Refusal, match=r"must be .* which is served here") as caught:
            serving.model(name, version)
        assert caught.value.status == 404
