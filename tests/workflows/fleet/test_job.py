"""The verb fleet: which parts, which words, the leaderboard, members that fail; the real verbs once."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import warm_starter

from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.execution import LocalPool
from attentionvote.files import write_json
from attentionvote.registry.history import History
from attentionvote.registry.promotion import move, stand
from attentionvote.registry.versions import Versions
from attentionvote.simulation.scene_set import generate_scene_set
from attentionvote.simulation.scene_spec import scene_set_directory
from attentionvote.workflows.export import ExportJob
from attentionvote.workflows.fleet import board as fleet_board
from attentionvote.workflows.fleet import job as fleet
from attentionvote.workflows.fleet.settings import FleetSettings
from attentionvote.workflows.settings import ExportSettings
from attentionvote.workflows.train.job import find_training
from attentionvote.workflows.train.preset import preset_of_workers
from attentionvote.workflows.train.settings import TrainSettings

ROOT = Path(__file__).resolve().parents[3]
TINY = [
    "experiment=smoke", "simulation.cycles.train=4", "simulation.drop_counts=[1,2]", "data.density=1500",
    "data.pool=800", "data.points=128", "trainer.batch_size=4", "trainer.max_epochs=2", "trainer.validate_every=2",
    "trainer.threads=1", "trainer.precision=32-true", "trainer.accelerator=cpu", "trainer.schedule.vote_steps=1",
    "trainer.schedule.ramp_steps=1", "tracking.system_interval=0", "force=false", "model.centers=[64,32,16,8]",
    "model.neighbors=[8,8,8,8]", "model.widths=[[8,16],[16,16],[16,16],[16,16]]", "model.propagation=[16,16]",
    "model.voting=[16]", "model.fusion=[16,16]", "model.head=[16]", "model.refinement.points=16",
    "model.refinement.widths=[8,16]", "model.refinement.head=[16]",
]  # fmt: skip


@pytest.fixture
def job(tmp_path: Path) -> Any:
    """The training of the brick on tiny scene sets."""
    return find_training(compose(TrainSettings, ["object=brick", *TINY, f"outputs={tmp_path / 'train'}"]))


def test_all_is_every_part_whose_mesh_is_there(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("ATTENTIONVOTE_DATA", str(tmp_path))
    jobs, left_out = fleet.members("all", TINY)
    assert {"brick", "gear", "connecting_rod"} <= set(jobs)
    assert sorted(left_out) == ["bunny", "industrial", "tless_20", "tless_22", "tless_29"]
    assert "SileaneBunny.obj" in left_out["bunny"]
    assert "object must be one part for objects=all, got industrial" in left_out["industrial"]
    assert list(fleet.members("gear, brick,gear", TINY)[0]) == ["gear", "brick"]
    with pytest.raises(ConfigurationError, match=r"^object bunny: .*SileaneBunny.obj"):
        fleet.members("brick,bunny", TINY)


@pytest.mark.parametrize(
    ("objects", "words", "message"),
    [
        ("brik", TINY, "objects must be all or among brick, .*; got 'brik', did you mean 'brick'"),
        ("", TINY, "objects= must leave one part that can be trained, got none"),
        ("brick", [*TINY, "trainer.batch_size=9"], "object brick: trainer.batch_size must be at most the 8 training"),
    ],
)
def test_parts_that_cannot_be_trained_are_refused_before_any_work(objects: str, words: list[str], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        fleet.members(objects, words)


def test_words_of_the_training_are_handed_on_and_those_of_the_fleet_are_not() -> None:
    words = [
        "objects='gear,brick'",
        "workers=2",
        "executor=ray",
        "cluster.gpus=1.0",
        "threads=4",
        "seed=3",
        "data.pool=9",
    ]
    assert fleet.training_words(words) == ["seed=3", "data.pool=9"]
    with pytest.raises(ConfigurationError, match="a fleet takes objects=NAME,NAME or objects=all, got object="):
        fleet.training_words(["object=gear"])


@pytest.mark.parametrize(("gpus", "preset"), [("1.0", "gpu"), ("0", "compact")])
def test_on_a_cluster_the_jobs_choose_the_preset_not_the_submitting_machine(gpus: str, preset: str) -> None:
    words = ["executor=slurm", f"cluster.gpus={gpus}"]
    assert preset_of_workers(compose(FleetSettings, words), words) == [f"experiment={preset}"]
    assert preset_of_workers(compose(FleetSettings, words), [*words, "experiment=paper"]) == []


def test_exports_and_evaluations_lie_beside_the_trainings() -> None:
    said = ["outputs=o/train", "root=d", "tracking.store=s.db", "export=['signing_keys=k','scenes=40']"]
    words, places = fleet.words_of_verbs(compose(FleetSettings, said), ["seed=3"], "brick")
    assert words["train"] == ("seed=3",)
    assert words["export"] == ("trained=o/train", "root=d", "outputs=o/export", "signing_keys=k", "scenes=40")
    expected = ("root=d", "bundles=o/export", "outputs=o/evaluate", "tracking.store=s.db", "trusted_key=k/signing.pub")
    assert words["evaluate"] == expected
    assert places == {"bundles": Path("o/export")}
    with pytest.raises(ConfigurationError, match="there is no setting 'scnes', did you mean 'scenes'"):
        fleet.words_of_verbs(compose(FleetSettings, ["export=['scnes=40']"]), [], "brick")


def test_data_is_stale_when_the_configuration_would_generate_other_scenes(job: Any, tmp_path: Path) -> None:
    now = {}
    for split in ("train", "val"):
        spec = job.specs[split]
        place = scene_set_directory(tmp_path / "scenes", "brick", spec)
        now[split] = generate_scene_set(job.part, spec, place, progress=False).digest
    assert fleet_board.stale_splits({**now, "test": "0" * 64}, job, tmp_path) == ["test"]  # never generated
    assert fleet_board.stale_splits({**now, "train": "0" * 64}, job, tmp_path) == ["train", "test"]


def test_a_row_tells_of_the_champion_and_of_its_stale_data(
    export_brick: Any, job: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = f"sqlite:///{tmp_path}/mlflow.db"
    versions = Versions(store, "brick")
    history = History(versions)
    first = export_brick("first")
    data = {f"data.{split}": digest for split, digest in first.card.data.items()}
    version = versions.register(first, data)
    move(versions, history, stand(versions, history), "promote", version, "the first")
    second = export_brick("second", card={"data": {"train": "4" * 64, "val": "5" * 64, "test": "6" * 64}})
    answers = {
        "evaluate": {
            "figures": {"ap_10": 0.9, "ap_5": 0.8, "ap_2": 0.4, "latency_p50_ms": 55.4},
            "intervals": {"ap_10": [0.85, 0.94], "ap_5": [0.7, 0.9], "ap_2": [0.3, 0.5]},
        },
        "seconds": 3.0,
    }
    judged: list[Any] = []

    def stale(trained_with: Any, *_: Any) -> list[str]:
        judged.append(dict(trained_with))
        return ["train"]

    monkeypatch.setattr(fleet_board, "stale_splits", stale)
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + 3.2 * 86_400)
    places = (tmp_path / "outputs" / "export", tmp_path / "data", store)
    known = fleet_board.row("brick", job, answers, *places)
    assert known["bundle"] == second.digest
    assert known["champion"] == {"version": 1, "age_days": pytest.approx(3.2, abs=0.02), "bundle": first.digest}
    assert judged == [first.card.data]  # of the champion, which cells run
    assert fleet_board.cells(known) == [
        "brick", "0.900", "0.800", "0.400", "0.850 to 0.940", "55 ms", "version 1, 3 d, another bundle", "train",
        "done",
    ]  # fmt: skip
    versions.set_champion(versions.register(second, {}))
    by_hand = fleet_board.row("brick", job, answers, *places)
    assert judged[1:] == [second.card.data]  # the champion is what lies here
    assert fleet_board.cells(by_hand)[6] == "version 2, moved by hand"
    failed = fleet_board.row("gear", job, {"failed": "train", "sentence": "no disk"}, tmp_path, tmp_path, store)
    assert failed["champion"] is None
    assert fleet_board.cells(failed) == ["gear", "", "", "", "", "", "none", "", "train: no disk"]
    better = {**known, "object": "rod", "ap_2": 0.5}
    rows = fleet_board.best_first([failed, known, better])
    assert [r["object"] for r in rows] == ["rod", "brick", "gear"]
    board = fleet_board.write(tmp_path, rows, {"bunny": "no mesh"})
    text = board.read_text()
    assert "| brick | 0.900 | 0.800 | 0.400 | 0.850 to 0.940 | 55 ms | version 1, 3 d, another bundle |" in text
    assert "- bunny: no mesh" in text
    stored = json.loads((tmp_path / "leaderboard.json").read_text())
    assert stored == {"members": rows, "left_out": {"bunny": "no mesh"}}


@dataclass(frozen=True)
class Deadly:
    """Ends the worker of one part, answers for the others."""

    deadly: str

    def __call__(self, name: str) -> dict[str, Any]:
        if name == self.deadly:
            os.kill(os.getpid(), signal.SIGKILL)
        return {"seconds": 0.1}


@pytest.fixture
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers import a task's module by name: this one goes by its file's."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    monkeypatch.setitem(sys.modules, Path(__file__).stem, sys.modules[__name__])
    monkeypatch.setattr(Deadly, "__module__", Path(__file__).stem)


@pytest.mark.usefixtures("importable")
def test_a_part_that_ends_its_workers_is_one_that_failed() -> None:
    answers = fleet._run(Deadly("gear"), ["brick", "gear", "rod"], LocalPool(), 2, 1, 1)  # type: ignore[arg-type]
    assert answers["brick"] == answers["rod"] == {"seconds": 0.1}
    assert answers["gear"] == {"failed": "worker", "sentence": "it died 2 times (signal 9)"}


@pytest.mark.slow
def test_a_fleet_goes_on_with_the_real_verbs_and_one_part_fails(export_brick: Any, tmp_path: Path) -> None:
    """The brick was trained and exported before a fleet was stopped; something lies in the way of the gear's scenes."""
    few = ["simulation=smoke", "simulation.drop_counts=[2,3]", "evaluation.cycles=2", "evaluation.density=2000"]
    words = ["objects='gear,brick'", *TINY, "outputs=outputs/train", "root=data", "tracking.store=mlflow.db"]
    words += ["export=['scenes=32']", f"evaluate={few}"]
    bundle = export_brick("model", "feed" * 8)
    trained = find_training(compose(TrainSettings, ["object=brick", *TINY, "outputs=outputs/train"])).directory
    trained.mkdir(parents=True)
    (trained / "model.ckpt").write_bytes(b"weights")
    write_json(trained / "result.json", {"stage": "train", "object": "brick", "run_id": "feed" * 8})
    ExportJob.find(compose(ExportSettings, ["object=brick", "scenes=32"])).finish(bundle, {})
    (tmp_path / "data" / "scenes").mkdir(parents=True)
    (tmp_path / "data" / "scenes" / "gear").touch()
    done = warm_starter.run(
        [sys.executable, ROOT / "pipelines" / "fleet.py", *words],
        capture_output=True, text=True, timeout=280, check=False, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    result = json.loads(done.stdout)
    brick, gear = result["members"]
    assert (brick["object"], brick["failed"], brick["bundle"]) == ("brick", None, bundle.digest)
    assert brick["ap_10"] is not None
    assert brick["latency_p50_ms"] > 0
    assert len(brick["intervals"]["ap_2"]) == 2
    assert result["failures"] == {"gear": gear["failed"]}
    assert gear["failed"].startswith("train: ")
    assert "scenes/gear" in gear["failed"]
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("fleet: 1 of 2 parts are not done: gear failed, train: ")
    assert "Traceback" not in done.stderr
    assert json.loads((tmp_path / "outputs" / "fleet" / "leaderboard.json").read_text())["members"] == result["members"]
    evaluated = json.loads(next((tmp_path / "outputs" / "evaluate" / "brick").glob("*.json")).read_text())
    assert evaluated["bundle"] == bundle.digest
