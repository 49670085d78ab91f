"""The verbs promote, rollback and history on complete bundles: what a user sees, and what stays afterwards."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import history
import promote
import pytest
import rollback
import warm_starter

from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError, Refused
from attentionvote.files import FolderUnavailable
from attentionvote.inference.bundles.signature import make_keys
from attentionvote.registry.versions import Versions
from attentionvote.tracking.run_opening import start_run
from attentionvote.workflows.settings import HistorySettings, PromoteSettings, RollbackSettings

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def store(request, tmp_path) -> str:
    """Of SQLite; a test that uses ``database`` runs on every kind."""
    if "database" in request.fixturenames:
        return request.getfixturevalue("database")
    return request.getfixturevalue("put_tables")(tmp_path / "mlflow.db")


@pytest.fixture
def model(export_brick, store, work_tree):
    """Exports a model that a training in the store made."""

    def make(name: str, **changes):
        with start_run(store, "brick", config_yaml="a: 1", repository=work_tree, system_interval_s=0) as run:
            pass
        return export_brick(name, run.id, run.commit, **changes)

    return make


SETTINGS = {"promote": PromoteSettings, "rollback": RollbackSettings, "history": HistorySettings}


@pytest.fixture
def verb(store, few_scenes, easy_gates):
    """Runs one of the verbs."""

    def call(name: str, *words: str):
        module = {"promote": promote, "rollback": rollback, "history": history}[name]
        settings = [*few_scenes, *easy_gates] if name == "promote" else ["object=brick"]
        return module.run(compose(SETTINGS[name], [*settings, f"tracking.store='{store}'", *words]))

    return call


@pytest.mark.usefixtures("database")
def test_from_promotion_to_rollback(verb, model, store, capsys):
    first = model("one")
    done = verb("promote", "why='the first one'")
    assert (done["version"], done["promoted"], done["before"]) == (1, True, None)
    assert done["bundle"] == first.digest
    second = model("two")
    done = verb("promote")
    assert (done["version"], done["before"], done["champion"]) == (2, 1, 2)
    assert done["gates"]["champion ap_10"]["found"].startswith(f"{done['figures']['ap_10']:.4f} +0.0000")
    table = " ".join(capsys.readouterr().err.split())
    assert "gates, against champion version 1" in table
    versions = Versions(store, "brick")
    champion = versions.champion()
    assert champion is not None
    assert (champion.digest, champion.tags["decision"]) == (second.digest, "promoted")
    assert champion.tags["gate.parity"].startswith("holds: a proof of parity")
    assert champion.tags["evaluation.set"] == done["evaluation_set"]
    assert champion.tags["ap_10"] == f"{done['figures']['ap_10']:.4f}"  # a number alone, to sort by
    page = versions.client.get_model_version(versions.name, "2").description
    assert f"| ap_10 | {done['figures']['ap_10']:.4f} |" in page
    assert "16 of 16 gates hold" in page
    measured = versions.client.get_run(champion.run_id).data.metrics
    assert measured["evaluation/ap_10"] == pytest.approx(done["figures"]["ap_10"], abs=1e-6)
    assert verb("promote")["promoted"] is False  # it is the champion already: nothing is measured
    back = verb("rollback", "why='misses parts'")
    assert (back["version"], back["before"], back["bundle"]) == (1, 2, first.digest)
    told = verb("history")
    assert told["champion"] == 1
    assert [(e["decision"], e["version"], e["before"], e["why"]) for e in told["events"]] == [
        ("promote", 1, None, "the first one"), ("promote", 2, 1, "all gates hold"), ("rollback", 1, 2, "misses parts"),
    ]  # fmt: skip
    assert [e["version"] for e in verb("history", "last=1")["events"]] == [1]
    assert verb("rollback", "to=2")["version"] == 2
    versions.client.delete_model_version(versions.name, "1")
    assert len(verb("history")["events"]) == 4  # the story survives the version


def test_a_model_that_fails_a_gate_stays_a_candidate_and_is_told(verb, model, store):
    model("one")
    verb("promote")
    bad = model("two", graph={"offsets": [[1.0, 0, 0]] * 4})
    said = r"brick version 2 stays a candidate, because 1 of 16 gates failed: floor ap_10 \(first: ap_10 at least 0.9"
    with pytest.raises(Refused, match=said) as refusal:
        verb("promote", "gates.floors.ap_10=0.9")
    assert (refusal.value.result["promoted"], refusal.value.result["champion"]) == (False, 1)
    assert refusal.value.result["gates"]["floor ap_10"]["holds"] is False
    versions = Versions(store, "brick")
    assert versions.champion().number == 1
    candidate = versions.of_bundle(bad.digest)
    assert candidate.tags["decision"] == "refused"
    assert candidate.tags["gate.floor ap_10"].startswith("FAILS: ap_10 at least 0.9; 0.0")
    event = verb("history")["events"][-1]
    assert (event["decision"], event["version"], event["before"]) == ("refuse", 2, 1)
    assert event["facts"]["gate.scenes"] == "holds: at least 2 scenes; measured on 2"
    # The same bundle may pass later, as the same version.
    assert verb("promote")["version"] == 2


def test_a_champion_that_cannot_be_verified_is_no_yardstick(verb, model, tmp_path):
    model("one")
    verb("promote")
    model("two")
    make_keys(tmp_path / "other")
    said = r"the champion, version 1, cannot be measured: .* must be signed by the trusted key .*; `make rollback`"
    with pytest.raises(ConfigurationError, match=said):
        verb("promote", f"champion_key={tmp_path}/other/signing.pub")
    assert len(verb("history")["events"]) == 1


def test_a_champion_by_hand_is_judged_like_any_other(verb, model, store):
    model("one")
    verb("promote")
    second = model("two")
    versions = Versions(store, "brick")
    versions.set_champion(versions.register(second, {}))
    done = verb("promote")
    assert (done["version"], done["promoted"]) == (2, True)
    assert verb("history")["events"][-1]["facts"]["compared"] == "against champion version 2"


def test_gates_can_be_switched_off_one_by_one(verb, model):
    model("one")
    verb("promote")
    model("two")
    done = verb("promote", "gates.margins.ap_2=null", "gates.floors.recall_10=null")
    assert "champion ap_2" not in done["gates"]
    assert "champion ap_5" in done["gates"]
    assert "floor recall_10" not in done["gates"]


def test_missing_provenance_is_refused(verb, export_brick):
    export_brick("orphan")
    with pytest.raises(Refused, match="stays a candidate, because 2 of 11 gates failed: commit, config"):
        verb("promote")


def test_what_cannot_be_done_is_said_before_any_work(verb, model, tmp_path):
    model("zero")
    with pytest.raises(ConfigurationError, match="a promotion must measure models as cells run them"):
        verb("promote", "evaluation.peak_threshold=0.3")
    shutil.rmtree(tmp_path / "outputs" / "export" / "brick")
    with pytest.raises(ConfigurationError, match="must hold a bundle, got none: run `make export OBJECT=brick`"):
        verb("promote")
    with pytest.raises(ConfigurationError, match="needs an earlier champion that still exists, got none"):
        verb("rollback")
    assert verb("history")["events"] == []
    with pytest.raises(
        ConfigurationError, match=r"gates\.floors\.ap_10 must be a number at least 0 and at most 1; got 2"
    ):
        verb("promote", "gates.floors.ap_10=2")
    model("one")
    (tmp_path / "data").write_text("a file")
    with pytest.raises(FolderUnavailable, match=r"data/scenes/brick/.* cannot be written: Not a directory"):
        verb("promote")


def test_a_rollback_to_a_version_whose_artefacts_are_gone_moves_nothing(verb, model, store, tmp_path):
    model("one")
    verb("promote")
    model("two")
    verb("promote")
    (gone,) = (p for p in (tmp_path / "mlartifacts" / "models").rglob("card.json") if '"one"' in p.read_text())
    gone.unlink()
    with pytest.raises(ConfigurationError, match=r"card\.json is missing"):
        verb("rollback")
    assert Versions(store, "brick").champion().number == 2


def wait_for_both(both: list[subprocess.Popen[str]], folders: list[Path]) -> None:
    """Whoever has seen where the champion stands, and makes a folder to measure in, waits until the other has, too."""
    waiting = dict(zip(folders, both, strict=True))
    until = time.monotonic() + 120
    while waiting:
        assert time.monotonic() < until
        for folder, process in list(waiting.items()):
            assert process.poll() is None, process.communicate()[1][-500:]
            if any(folder.glob("attentionvote-*")):
                process.send_signal(signal.SIGSTOP)
                del waiting[folder]
        time.sleep(0.005)
    for process in both:
        process.send_signal(signal.SIGCONT)


@pytest.mark.usefixtures("database")
@pytest.mark.slow
def test_of_two_processes_that_promote_at_once_exactly_one_wins(verb, model, store, few_scenes, easy_gates, tmp_path):
    model("zero")
    verb("promote")
    words = [*few_scenes, *easy_gates, f"tracking.store='{store}'"]
    command = [sys.executable, str(ROOT / "pipelines" / "promote.py"), *words, "gates.scenes=1"]
    digests = [model(name).digest for name in ("one", "two")]
    folders = [tmp_path / f"temporary_{digest[:4]}" for digest in digests]
    for folder in folders:
        folder.mkdir()
    both = [
        start(
            [*command, f"bundle='{digest[:12]}'"], cwd=tmp_path, env=dict(os.environ) | {"TMPDIR": str(folder)},
            text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )
        for start, digest, folder in zip((warm_starter.Popen, subprocess.Popen), digests, folders, strict=True)
    ]  # fmt: skip
    wait_for_both(both, folders)
    ends = [process.communicate(timeout=200) for process in both]
    codes = sorted(process.returncode for process in both)
    assert codes == [0, 1], [end[1][-500:] for end in ends]
    winner = next(i for i in range(2) if both[i].returncode == 0)
    assert json.loads(ends[winner][0])["bundle"] == digests[winner]
    assert "came first: run the same command again to decide against the new champion" in ends[1 - winner][1]
    assert json.loads(ends[1 - winner][0])["promoted"] is False
    assert "outputs/logs" not in ends[1 - winner][1]
    versions = Versions(store, "brick")
    assert versions.champion().digest == digests[winner]
    assert versions.of_bundle(digests[1 - winner]).tags["decision"] == "superseded"
    events = verb("history")["events"]
    assert [(e["decision"], e["counts"]) for e in events[-2:]] == [("promote", True), ("promote", False)]
