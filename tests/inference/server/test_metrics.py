"""The metrics page: always readable, whatever a sentence holds."""

from __future__ import annotations

import pytest
from prometheus_client.parser import text_string_to_metric_families

from attentionvote.inference.fetching.reference import RegistryVersion
from attentionvote.inference.server.metrics import Metrics


def samples(metrics: Metrics) -> dict[tuple[str, ...], float]:
    """Values by name and labels."""
    families = text_string_to_metric_families(metrics.text().decode())
    return {(s.name, *s.labels.values()): s.value for family in families for s in family.samples}


@pytest.mark.parametrize("sentence", ["plain", 'with "quotes"', "back\\slash", "two\nlines", "…ümlaut"])
def test_the_reason_is_readable_and_alone(sentence: str) -> None:
    metrics = Metrics()
    metrics.reload_problem("another one before")
    metrics.reload_problem(sentence)
    found = {key: value for key, value in samples(metrics).items() if key[0] == "attentionvote_reload_error_info"}
    assert found == {("attentionvote_reload_error_info", sentence): 1.0}
    assert samples(metrics)["attentionvote_reload_failing",] == 1.0
    metrics.reload_problem(None)
    assert "attentionvote_reload_error_info" not in {key[0] for key in samples(metrics)}
    assert samples(metrics)["attentionvote_reload_failing",] == 0.0


def test_one_model_serves() -> None:
    metrics = Metrics()
    for version in ("aa", "bb"):
        metrics.serving("gear", version, version * 32, saved=version == "aa", last_known_good=version == "bb")
    found = samples(metrics)
    assert [key[1:] for key in found if key[0] == "attentionvote_model_info"] == [("bb" * 32, "gear", "bb")]
    assert found["attentionvote_last_known_good_kept",] == 0.0
    assert found["attentionvote_serving_last_known_good",] == 1.0


def test_two_servers_in_a_process_count_apart() -> None:
    first, second = Metrics(), Metrics()
    first.requests.labels("ok").inc()
    assert samples(first)["attentionvote_requests_total", "ok"] == 1.0
    assert samples(second)["attentionvote_requests_total", "ok"] == 0.0  # counted from 0, not absent


def test_the_registered_version_and_the_registrys_problem_are_alone() -> None:
    metrics = Metrics()
    for number in ("1", "2"):
        metrics.registered(RegistryVersion("attentionvote-gear", number, number * 64))
        metrics.registry_problem(f"reason {number}")
    found = samples(metrics)
    assert [key[1:] for key in found if key[0] == "attentionvote_registry_info"] == [
        ("2" * 64, "attentionvote-gear", "2")
    ]
    assert [key[1:] for key in found if key[0] == "attentionvote_registry_error_info"] == [("reason 2",)]
    assert found["attentionvote_registry_failing",] == 1.0
    metrics.registered(None)
    metrics.registry_problem(None)
    found = samples(metrics)
    assert not [key for key in found if key[0] in ("attentionvote_registry_info", "attentionvote_registry_error_info")]
    assert found["attentionvote_registry_failing",] == 0.0
    assert found["attentionvote_registry_polls_total", "away"] == 0.0
