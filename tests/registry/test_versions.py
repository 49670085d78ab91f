"""Versions in a real store: what is registered comes back bit by bit, once, and what it came from is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from attentionvote.inference import load_bundle
from attentionvote.registry.gates import Origin
from attentionvote.tracking.provenance import git_state
from attentionvote.tracking.run_opening import start_run


def test_a_bundle_is_registered_once_and_comes_back_whole(versions, make_model, trusted_key, tmp_path):
    assert (versions.all(), versions.champion(), versions.of_bundle("x")) == ([], None, None)
    bundle = make_model()
    version = versions.register(bundle, {"decision": "passed"})
    assert (version.number, version.digest, version.tags["decision"]) == (1, bundle.digest, "passed")
    again = versions.register(bundle, {"decision": "refused"})
    assert again.number == 1
    assert [v.tags["decision"] for v in versions.all()] == ["refused"]
    assert versions.fetch(version, tmp_path / "fetched", trusted_key).digest == bundle.digest


def test_candidate_is_the_newest_and_champion_the_chosen(versions, make_model):
    first, second = (versions.register(make_model(t), {}) for t in (0.5, 0.6))
    assert versions.champion() is None
    versions.set_champion(first)
    assert versions.champion() == first
    client = versions.client
    assert int(client.get_model_version_by_alias(versions.name, "candidate").version) == second.number


def test_a_deleted_champion_is_no_champion(versions, make_model):
    version = versions.register(make_model(), {})
    versions.set_champion(version)
    versions.client.delete_model_version(versions.name, str(version.number))
    assert versions.champion() is None


def test_artefacts_that_are_gone_are_said_and_registered_anew(versions, make_model, trusted_key, tmp_path):
    bundle = make_model()
    version = versions.register(bundle, {})
    (model,) = (
        (tmp_path / "outputs").rglob("model.onnx") if _is_database(versions) else tmp_path.rglob("m-*/**/model.onnx")
    )
    for path in sorted(model.parent.rglob("*"), reverse=True):
        path.unlink() if path.is_file() else path.rmdir()
    model.parent.rmdir()
    with pytest.raises(ValueError, match="the artefacts of attentionvote-bracket must be in the store"):
        versions.fetch(version, tmp_path / "fetched", trusted_key)
    # The bundle is still on this machine: it becomes a version that can be fetched.
    again = versions.register(bundle, {})
    assert again.number == 2
    assert versions.fetch(again, tmp_path / "fetched", trusted_key).digest == bundle.digest


def _is_database(versions) -> bool:
    return not versions.uri.startswith("sqlite")


def test_what_the_store_spoils_is_not_registered(versions, make_model, monkeypatch):
    bundle = make_model()
    store, client = versions.client.log_model_artifacts, versions.client

    def spoiling(model_id: str, folder: str) -> None:
        store(model_id, folder)
        location = client.get_logged_model(model_id).artifact_location
        card = Path(location.removeprefix("file://")) / "card.json"
        card.write_text(card.read_text() + " ")

    monkeypatch.setattr(client, "log_model_artifacts", spoiling)
    with pytest.raises(OSError, match=r"the registry must give back the bundle it got, but .*card\.json"):
        versions.register(bundle, {})
    assert versions.all() == []


def test_the_origin_is_what_the_training_left_in_the_store(versions, work_tree):
    assert versions.origin("", "key") == Origin(False, signed_by="key")
    assert versions.origin("feed" * 8, "key") == Origin(False, signed_by="key")
    settings = {"config_yaml": "a: 1\n", "repository": work_tree, "system_interval_s": 0}
    with start_run(versions.uri, "bracket", **settings) as clean:
        pass
    assert versions.origin(clean.id, "key") == Origin(True, True, (clean.commit,), True, "key")
    (work_tree / "a.txt").write_text("new\n")
    with start_run(versions.uri, "bracket", run_id=clean.id, **settings) as dirty:
        pass
    assert versions.origin(clean.id, "") == Origin(True, True, (clean.commit, dirty.commit), True)
    for spoiled in ("", "diff"):
        versions.client.log_text(clean.id, spoiled, "resume_1/uncommitted.patch")
        assert not versions.origin(clean.id, "").has_changes


def test_changes_that_were_cut_are_not_recorded(versions, work_tree, monkeypatch):
    monkeypatch.setattr(git_state, "__defaults__", (10,))
    (work_tree / "a.txt").write_text("new\n" * 10)
    with start_run(versions.uri, "bracket", repository=work_tree, system_interval_s=0) as run:
        pass
    assert versions.origin(run.id, "") == Origin(True, False, (run.commit,), False)


def test_a_version_belongs_to_the_run_of_its_training(versions, make_bundle, trusted_key, tmp_path):
    with start_run(versions.uri, "elsewhere", repository=tmp_path, system_interval_s=0) as run:
        pass
    bundle = load_bundle(make_bundle("of_a_run", card={"run_id": run.id}), trusted_key)
    assert versions.register(bundle, {}).run_id == run.id


def test_artefacts_of_another_bundle_are_not_taken_for_a_version(versions, make_model, trusted_key, tmp_path):
    first, second = (versions.register(make_model(t), {}) for t in (0.5, 0.6))
    with pytest.raises(ValueError, match=r"must be bundle \w{12} of bracket, but its artefacts are bundle \w{12} of"):
        versions.fetch(replace(first, digest=second.digest), tmp_path / "fetched", trusted_key)


def test_gates_of_an_earlier_decision_do_not_stay(versions, make_model):
    bundle = make_model()
    versions.register(bundle, {"decision": "refused", "gate.floor ap_10": "FAILS", "gate.latency": "holds"})
    version = versions.register(bundle, {"decision": "passed", "gate.latency": "holds"})
    assert "gate.floor ap_10" not in versions.of_bundle(version.digest).tags
    versions.tag(versions.of_bundle(version.digest), {"decision": "promoted"})
    assert versions.of_bundle(version.digest).tags["gate.latency"] == "holds"
