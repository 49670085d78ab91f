"""Batching, order and failures of the metric queue, with a store that records or refuses."""

import logging

import pytest

from attentionvote.tracking.metric_writer import BATCH, MetricWriter, metric_name


class Store:
    """Records the batches; refuses while ``down``."""

    def __init__(self) -> None:
        self.down = False
        self.batches: list[list[tuple[str, int]]] = []

    def log_batch(self, run_id: str, metrics) -> None:
        assert run_id == "run"
        if self.down:
            raise ConnectionError("the store is down\nwith a page of details")
        self.batches.append([(metric.key, metric.step) for metric in metrics])


@pytest.fixture
def store():
    return Store()


def test_everything_arrives_once_in_order_in_batches(store):
    writer = MetricWriter(store, "run", interval_s=60)
    for step in range(BATCH):
        writer.add({"a": 1.0, "b": 2.0}, step)
    assert writer.flush(20)
    rows = [row for batch in store.batches for row in batch]
    assert rows == [(name, step) for step in range(BATCH) for name in ("a", "b")]
    assert max(map(len, store.batches)) <= BATCH
    assert writer.close(1) == 0


def test_store_that_is_away_costs_one_warning_and_no_metric(store, caplog):
    caplog.set_level(logging.WARNING)
    store.down = True
    writer = MetricWriter(store, "run", interval_s=0.01)
    for step in range(10):
        writer.add({"a": 1.0}, step)
        assert not writer.flush(0.05)
    assert caplog.text.count("metrics wait in memory") == 1
    assert "page of details" not in caplog.text
    store.down = False
    assert writer.flush(10)
    assert [row for batch in store.batches for row in batch] == [("a", step) for step in range(10)]
    writer.close(1)


def test_capacity_drops_the_oldest_and_close_counts_the_lost(store):
    store.down = True
    writer = MetricWriter(store, "run", interval_s=0.01, capacity=5)
    for step in range(20):
        writer.add({"a": 1.0}, step)
    assert not writer.flush(0.1)
    assert writer.close(0.1) == 5


def test_repeated_steps_of_a_resumed_series_are_skipped(store):
    writer = MetricWriter(store, "run", last_steps={"train/loss": 5, "test/ap_10": 5})
    for step in (4, 5, 6):
        writer.add({"train/loss": 1.0, "test/ap_10": 1.0, "new": 1.0}, step)
    writer.close(10)
    rows = [row for batch in store.batches for row in batch]
    assert [step for name, step in rows if name == "train/loss"] == [6]
    assert [step for name, step in rows if name == "test/ap_10"] == [4, 5, 6]
    assert [step for name, step in rows if name == "new"] == [4, 5, 6]


def test_metric_name_keeps_what_mlflow_takes():
    assert metric_name("val/ap@10 %") == "val/ap_10 _"
    assert metric_name("train/loss/vote") == "train/loss/vote"
