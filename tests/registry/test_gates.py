"""Every gate: where it holds, where it fails, at the limit itself, and what it says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from attentionvote.evaluation import LeftOut
from attentionvote.export.parity_record import Limits, Parity
from attentionvote.registry.gates import Evidence, Gate, Origin, Rules, judge

LIMITS = Limits(0.1, 0.01, 0.1, 0.01, 0.01, 0.001, 0, 0.002, scenes=32)
RULES = Rules(100, {"ap_10": 0.9}, {"ap_10": 0.01}, latency_p95_ms=500.0, parity=LIMITS)
PARITY = Parity(32, 100, 0, 0.0007, 0.0001, 0.0008, 0.0001, 0.0001, 0.0001, {"ap_10": (0.95, 0.95)})
COMMIT = "0123456789abcdef0123456789abcdef01234567"
ORIGIN = Origin(True, has_config=True, commits=(COMMIT,), has_changes=True, signed_by="feedfeedfeedfeed")


def evidence(ap: float, reach: float = 0.0, p95: float = 300.0) -> Evidence:
    """Of a model whose AP of 30 cycles has an interval that reaches so far."""
    without = ap + reach / (2.04523 * np.sqrt(29)) * np.tile([-1, 1], 15)  # Student's t of 29
    return Evidence({"ap_10": ap, "latency_p50_ms": 200.0, "latency_p95_ms": p95}, {"ap_10": LeftOut(ap, without)})


@pytest.fixture
def card(make_card):
    return make_card(
        parity={"limits": {}, "paths": {"CPU": PARITY.as_dict()}},
        data={"train": "1" * 64, "val": "2" * 64, "test": "3" * 64},
        run_id="feed" * 8,
        commit=COMMIT,
        versions={"attentionvote": "0.1.0", "torch": "2.13.0", "onnx": "1.23.2", "onnxruntime": "1.31.1"},
    )


def judged(card, candidate=None, champion=None, origin=ORIGIN, scenes=130, rules=RULES) -> dict[str, Gate]:
    return {gate.name: gate for gate in judge(rules, candidate or evidence(0.95), champion, card, origin, scenes)}


def test_a_good_first_model_passes_every_gate(card):
    gates = judged(card)
    assert all(gate.holds for gate in gates.values())
    assert list(gates) == [
        "scenes", "floor ap_10", "latency", "parity", "commit", "data", "config", "versions", "signature",
    ]  # fmt: skip
    assert gates["parity"].finding == "CPU 0.0007 mm, 0.0008 degrees"
    assert str(gates["latency"]) == "holds: p95 at most 500 ms; 300 ms (p50 200)"


@pytest.mark.parametrize(("scenes", "holds"), [(100, True), (99, False)])
def test_too_small_a_set_proves_nothing(card, scenes, holds):
    assert judged(card, scenes=scenes)["scenes"].holds is holds


@pytest.mark.parametrize(("ap", "holds"), [(0.9, True), (0.8999, False)])
def test_the_floor_is_inclusive_and_shows_the_interval(card, ap, holds):
    gate = judged(card, evidence(ap, 0.02))["floor ap_10"]
    assert gate.holds is holds
    assert gate.finding == f"{ap:.4f} (0.879 to 0.919)"  # a little more room below than above


def test_a_figure_that_was_not_measured_fails(card):
    rules = replace(RULES, floors={"ap_7": 0.1}, margins={"ap_7": 0.1})
    gates = judged(card, champion=evidence(0.9), rules=rules)
    assert (gates["floor ap_7"].holds, gates["floor ap_7"].finding) == (False, "it was not measured")
    assert (gates["champion ap_7"].holds, gates["champion ap_7"].finding) == (False, "it was not measured for both")


def test_no_worse_than_the_champion_means_that_a_larger_loss_is_excluded(card):
    # Both hang on the same piles, so their difference is certain: 0.009 below passes a margin of 0.01.
    assert judged(card, evidence(0.941, 0.05), evidence(0.95, 0.05))["champion ap_10"].holds
    assert not judged(card, evidence(0.939, 0.05), evidence(0.95, 0.05))["champion ap_10"].holds
    # The same mean with a spread of the difference beyond the margin: not excluded.
    unsure = judged(card, evidence(0.95, 0.05), evidence(0.95, 0.0))["champion ap_10"]
    assert not unsure.holds
    assert unsure.finding == "0.9500 +0.0000 (-0.0500 to +0.0500)"


def test_of_one_drop_cycle_nothing_is_excluded(card):
    one = replace(evidence(0.95), left_out={})
    gates = judged(card, one, one)
    assert (gates["floor ap_10"].holds, gates["floor ap_10"].finding) == (True, "0.9500")
    assert not gates["champion ap_10"].holds
    assert gates["champion ap_10"].finding == "of one drop cycle no interval is known: measure on more"


def test_a_better_model_passes_whatever_the_margin(card):
    rules = replace(RULES, margins={"ap_10": 0.0})
    assert judged(card, evidence(0.97), evidence(0.95), rules=rules)["champion ap_10"].holds


@pytest.mark.parametrize(("p95", "holds"), [(500.0, True), (500.1, False)])
def test_the_latency_budget(card, p95, holds):
    assert judged(card, evidence(0.95, p95=p95))["latency"].holds is holds


@pytest.mark.parametrize(
    ("record", "said"),
    [
        ({}, "the card holds no proof"),
        ({"paths": {}}, "the card holds no proof"),
        ({"paths": {"CPU": {"pairs": 3}}}, "CPU: a record of parity must have the fields"),
        ({"paths": {"CPU": replace(PARITY, translation_mm=0.2).as_dict()}}, "CPU: translation_mm must be at most 0.1"),
        ({"paths": {"CPU": PARITY.as_dict(), "CUDA": replace(PARITY, unmatched=1).as_dict()}}, "CUDA: unmatched must"),
    ],
)
def test_the_proof_is_judged_again_whatever_limits_the_export_had(card, record, said):
    gate = judged(replace(card, parity=record))["parity"]
    assert not gate.holds
    assert gate.finding.startswith(said)


DIRTY, OTHER = f"{COMMIT}+dirty", "f" * 40


@pytest.mark.parametrize(
    ("said", "commits", "has_changes", "holds", "found"),
    [
        (COMMIT, [COMMIT], False, True, COMMIT[:12]),
        (DIRTY, [DIRTY], True, True, f"{COMMIT[:12]} with changes that are recorded"),
        (DIRTY, [DIRTY], False, False, f"{COMMIT[:12]} with changes that are not recorded whole"),
        (COMMIT, [OTHER, COMMIT], False, True, f"{OTHER[:12]} then {COMMIT[:12]}"),
        (COMMIT, [DIRTY, COMMIT], False, False, f"{COMMIT[:12]} with changes that are not recorded whole"),
        (COMMIT, [DIRTY], True, False, f"the card says {COMMIT}, the run {DIRTY}"),
        (OTHER, [COMMIT], True, False, f"the card says {OTHER}, the run {COMMIT}"),
        ("unknown", ["unknown"], True, False, "the card says unknown, the run names none"),
        (COMMIT, [], True, False, f"the card says {COMMIT}, the run names none"),
        ("", [COMMIT], True, False, f"the card says none, the run {COMMIT}"),
    ],
)
def test_the_commit_is_the_runs_own_and_clean_or_its_changes_are_recorded(
    card, said, commits, has_changes, holds, found
):
    origin = replace(ORIGIN, commits=tuple(commits), has_changes=has_changes)
    gate = judged(replace(card, commit=said), origin=origin)["commit"]
    assert (gate.holds, gate.finding) == (holds, found)


def test_missing_provenance_fails_one_gate_each(card):
    assert judged(replace(card, data={"train": "1", "test": "3"}))["data"].finding == "no val digest"
    assert judged(replace(card, versions={}))["versions"].finding == "no attentionvote"
    assert judged(replace(card, run_id=""))["config"].finding == "the card names no run"
    assert judged(card, origin=replace(ORIGIN, has_run=False))["config"].finding == "run feedfeed is not in the store"
    assert judged(card, origin=replace(ORIGIN, has_config=False))["config"].finding == "run feedfeed has no config.yaml"
    assert judged(card, origin=replace(ORIGIN, signed_by=""))["signature"].finding == "no signature was verified"
    for card_, origin, name in (
        (replace(card, data={}), ORIGIN, "data"),
        (replace(card, versions={}), ORIGIN, "versions"),
        (replace(card, run_id=""), replace(ORIGIN, has_run=False), "config"),
        (card, replace(ORIGIN, signed_by=""), "signature"),
    ):
        assert [gate.name for gate in judged(card_, origin=origin).values() if not gate.holds] == [name]


def test_only_the_provenance_that_is_demanded_is_judged(card):
    gates = judged(replace(card, commit=""), rules=replace(RULES, provenance=("signature",)))
    assert list(gates)[-2:] == ["parity", "signature"]
    assert all(gate.holds for gate in gates.values())
