"""What serves: by name and version, and how it is exchanged."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from attentionvote.inference.answer import Estimate
from attentionvote.inference.estimator import PoseEstimator
from attentionvote.inference.server.metrics import Metrics
from attentionvote.inference.server.model.serving import Served, Serving
from attentionvote.inference.server.refusal import Refusal


@pytest.fixture
def serving() -> Iterator[Serving]:
    """Without a model."""
    made = Serving(Metrics())
    yield made
    made.close()


def test_the_old_one_is_closed_after_its_last_request(
    serving: Serving, make_bundle: Callable[..., Path], trusted_key: Path, make_cloud: Callable[..., Any]
) -> None:
    old = PoseEstimator(make_bundle("old"), trusted=trusted_key)
    new = PoseEstimator(make_bundle("new", graph={"heat": (9.0, 6.0, 3.0, 1.0)}), trusted=trusted_key)
    cloud, go_on = make_cloud(), threading.Event()
    serving.swap(Served(old, kept=True, last_known_good=False))

    def slow() -> Any:
        assert go_on.wait(20)
        return old.estimate(cloud)

    running, waiting = serving.submit(slow), serving.submit(old.estimate, cloud)
    serving.swap(Served(new, kept=True, last_known_good=False))
    assert serving.model().estimator is new
    go_on.set()
    assert isinstance(running.result(20), Estimate)
    assert waiting.result(20).model == old.digest[:12]
    serving.submit(int).result(20)  # everything before it has been done
    with pytest.raises(RuntimeError, match="closed"):
        old.estimate(cloud)
    assert len(new.estimate(cloud).detections) == 3  # type: ignore[union-attr]


def test_what_only_changes_its_facts_is_not_closed(
    serving: Serving, bundle_folder: Path, trusted_key: Path, make_cloud: Callable[..., Any]
) -> None:
    estimator = PoseEstimator(bundle_folder, trusted=trusted_key)
    serving.swap(Served(estimator, kept=False, last_known_good=False))
    serving.swap(Served(estimator, kept=True, last_known_good=False))
    serving.submit(int).result(20)
    assert isinstance(estimator.estimate(make_cloud()), Estimate)


def test_a_model_is_the_one_asked_for_or_refused(serving: Serving, bundle_folder: Path, trusted_key: Path) -> None:
    serving.waits_for = "the disk is empty"
    with pytest.raises(Refusal, match="no model is ready: the disk is empty") as caught:
        serving.model()
    assert (caught.value.status, caught.value.headers) == (503, {"Retry-After": "2"})
    served = Served(PoseEstimator(bundle_folder, trusted=trusted_key), kept=True, last_known_good=False)
    serving.swap(served)
    for name, version in ((None, None), ("bracket", None), ("bracket", served.version), (None, served.version)):
        assert serving.model(name, version) is served
    for name, version in (("Bracket", None), ("", None), ("bracket", ""), ("bracket", served.digest)):
        with pytest.raises(Refusal, match=r"must be .* which is served here") as caught:
            serving.model(name, version)
        assert caught.value.status == 404
