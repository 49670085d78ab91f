"""Scene sets: deterministic, resumable, guarded."""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from real_disks import read_only, resize, small_disk

from attentionvote.files import DiskFull, FolderUnavailable
from attentionvote.geometry.pose import inverse
from attentionvote.part import Part
from attentionvote.simulation import cycle, cycle_pool, scene_set
from attentionvote.simulation.camera import Camera, CameraSettings
from attentionvote.simulation.drop_settings import DropSettings
from attentionvote.simulation.raycast import PartCaster
from attentionvote.simulation.scene_record import SceneRecord
from attentionvote.simulation.scene_set import SceneSet, content_digest, find_record, generate_scene_set
from attentionvote.simulation.scene_spec import SceneSetSpec

COARSE = DropSettings(timestep=0.008, contact_time=0.02)


@pytest.fixture(autouse=True)
def known_hulls(hulls: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bracket's two boxes; coacd has its own tests."""
    monkeypatch.setattr(cycle, "convex_hulls", lambda *_, **__: hulls)


def make_spec(part: Part, **changes: object) -> SceneSetSpec:
    camera = CameraSettings(Camera(320, 240, 500, 500, 160, 120))
    spec = SceneSetSpec(part.digest, "train", 4, drop_counts=(1, 3), drop=COARSE, camera=camera, visibility_stride=3)
    return replace(spec, **changes)  # type: ignore[arg-type]


def test_a_set_holds_what_its_specification_says(bracket: Part, tmp_path: Path) -> None:
    spec = make_spec(bracket)
    scenes = generate_scene_set(bracket, spec, tmp_path / "set", progress=False)
    assert [(r.cycle, r.drop_count) for r in scenes] == [(c, k) for c in range(4) for k in (1, 3)]
    assert len(scenes) == 8
    assert scenes.spec_digest == spec.digest()
    for r in scenes:
        assert r.camera_from_part.shape == (r.drop_count, 4, 4)
        assert ((r.visible_fraction >= 0) & (r.visible_fraction <= 1)).all()
        bin_from_part = inverse(r.camera_from_bin) @ r.camera_from_part
        assert (np.abs(bin_from_part[:, :2, 3]) < r.bin_size[:2] / 2).all()
        assert 0.2 <= r.friction <= 0.6
    a, b = scenes.records[:2]  # same cycle: the same bin and first part, another camera
    np.testing.assert_array_equal(a.bin_size, b.bin_size)
    assert not np.allclose(a.camera_from_bin, b.camera_from_bin, atol=1e-4)
    assert a.scene_seed != b.scene_seed
    assert len({r.friction for r in scenes}) == 4
    assert sorted(p.name for p in (tmp_path / "set").iterdir()) == [".lock", "cycles", "hulls.npz", "manifest.json"]
    assert len(list((tmp_path / "set" / "cycles").iterdir())) == 4


def test_what_a_thinned_set_keeps_is_as_in_the_full_one(bracket: Part, tmp_path: Path) -> None:
    full = make_spec(bracket, drop_counts=(1, 2, 3, 4))
    thin, low = replace(full, keep_every=3), replace(full, pile_share=0.5)
    everything = {
        (r.cycle, r.drop_count): r for r in generate_scene_set(bracket, full, tmp_path / "full", progress=False)
    }
    scenes = generate_scene_set(bracket, thin, tmp_path / "thin", progress=False)
    places = [(0, 1), (0, 4), (1, 2), (2, 3), (3, 1), (3, 4)]
    assert [(r.cycle, r.drop_count) for r in scenes] == places
    assert (len(scenes), list(scenes.cycle_of_scene)) == (thin.scenes, [0, 0, 1, 2, 3, 3])
    low_scenes = generate_scene_set(bracket, low, tmp_path / "low", progress=False)
    assert [(r.cycle, r.drop_count) for r in low_scenes] == [(cycle, count) for cycle in range(4) for count in (1, 2)]
    for r in [*scenes, *low_scenes]:
        same = everything[r.cycle, r.drop_count]
        np.testing.assert_array_equal(r.camera_from_part, same.camera_from_part)
        np.testing.assert_array_equal(r.camera_from_bin, same.camera_from_bin)
        np.testing.assert_array_equal(r.bin_size, same.bin_size)
        assert r.scene_seed == same.scene_seed
    caster = PartCaster(bracket)
    for number, place in enumerate(places):
        r = find_record(bracket, caster, thin, tmp_path / "not generated", number)
        assert (r.cycle, r.drop_count) == place
        np.testing.assert_allclose(r.camera_from_part, everything[place].camera_from_part, atol=1e-12)
    with pytest.raises(ValueError, match="scene must be below 6 in split train; got 6"):
        find_record(bracket, caster, thin, tmp_path / "not generated", 6)


def test_two_workers_give_the_same_bits_as_one(
    bracket: Part, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = make_spec(bracket)
    one = generate_scene_set(bracket, spec, tmp_path / "one", workers=1, progress=False)
    two = generate_scene_set(bracket, spec, tmp_path / "two", workers=2, progress=True)
    assert one.digest == two.digest
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a.camera_from_part, b.camera_from_part)
    out, err = capsys.readouterr()
    assert "4/4" in err
    assert out == ""


def test_a_complete_set_is_not_touched(bracket: Part, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = make_spec(bracket, cycles=1, drop_counts=(1,))
    first = generate_scene_set(bracket, spec, tmp_path, progress=False)
    monkeypatch.setattr(scene_set, "run_cycles", lambda *_, **__: pytest.fail("simulated again"))
    assert generate_scene_set(bracket, spec, tmp_path, progress=False).digest == first.digest
    assert SceneSet.is_complete(tmp_path)
    monkeypatch.setattr(scene_set, "waiting_lock", lambda *_: pytest.fail("a lock was written"))
    assert generate_scene_set(bracket, spec, tmp_path, progress=False).digest == first.digest


def test_a_complete_set_is_used_where_nothing_can_be_written(bracket: Part, tmp_path: Path) -> None:
    spec = make_spec(bracket, cycles=1, drop_counts=(1,))
    first = generate_scene_set(bracket, spec, tmp_path / "set", progress=False)
    (tmp_path / "set" / ".lock").unlink()  # as a copy on a read-only mount may be
    with read_only(tmp_path):
        assert generate_scene_set(bracket, spec, tmp_path / "set", progress=False).digest == first.digest
        with pytest.raises(FolderUnavailable, match=rf"{tmp_path}/new cannot be written: Read-only file system"):
            generate_scene_set(bracket, spec, tmp_path / "new", progress=False)


def test_a_full_disk_is_named_and_the_set_goes_on(bracket: Part, tmp_path: Path) -> None:
    spec = make_spec(bracket)
    whole = generate_scene_set(bracket, spec, tmp_path / "whole", progress=False)
    with small_disk(tmp_path / "disk", "16k") as disk:
        with pytest.raises(
            DiskFull, match=rf"^the disk of {disk}/set/cycles must have room, but [\d,]+ bytes are free"
        ):
            generate_scene_set(bracket, spec, disk / "set", progress=False)
        finished = sorted((disk / "set" / "cycles").iterdir())
        assert [path.name[0] for path in finished] == ["0"] * len(finished)  # nothing half written
        resize(disk, "1m")
        assert generate_scene_set(bracket, spec, disk / "set", progress=False).digest == whole.digest


def test_splits_and_seeds_are_other_scenes_and_longer_sets_continue(bracket: Part, tmp_path: Path) -> None:
    spec = make_spec(bracket, cycles=1, drop_counts=(1,))
    sets = [
        generate_scene_set(bracket, s, tmp_path / str(i), progress=False)
        for i, s in enumerate((spec, replace(spec, split="val"), replace(spec, seed=1), replace(spec, cycles=2)))
    ]
    assert len({s.digest for s in sets}) == 4
    poses = [s.records[0].camera_from_part for s in sets]
    assert not np.allclose(poses[0], poses[1], atol=1e-3)
    assert not np.allclose(poses[0], poses[2], atol=1e-3)
    np.testing.assert_array_equal(poses[0], poses[3])


def test_the_digest_sees_a_micrometre_and_ignores_the_last_bits(bracket: Part, tmp_path: Path) -> None:
    spec = make_spec(bracket, cycles=1, drop_counts=(1,))
    digest = generate_scene_set(bracket, spec, tmp_path, progress=False).digest
    shard = tmp_path / "cycles" / "00000.npz"
    with np.load(shard) as stored:
        fields = dict(stored)
    for shift, same in ((1e-12, True), (2e-6, False)):
        moved = fields["camera_from_part"] + np.array([0, 0, 0, 0, shift, 0, 0])
        np.savez(shard, **{**fields, "camera_from_part": moved})
        assert (content_digest(tmp_path, 1) == digest) == same


def test_another_specification_in_the_directory_is_refused(bracket: Part, tmp_path: Path) -> None:
    spec = make_spec(bracket, cycles=1, drop_counts=(1,))
    generate_scene_set(bracket, spec, tmp_path, progress=False)
    other = replace(spec, seed=5)
    message = f"holds scene set {spec.digest()[:12]}, but {other.digest()[:12]} was asked for: choose another directory"
    with pytest.raises(ValueError, match=message):
        generate_scene_set(bracket, other, tmp_path, progress=False)


def test_unusable_directories_and_arguments(bracket: Part, tmp_path: Path) -> None:
    spec = make_spec(bracket)
    with pytest.raises(ValueError, match=r"must hold a scene set, but it has no manifest.json"):
        SceneSet.open(tmp_path)
    with pytest.raises(ValueError, match="bracket: the scene set is specified for part 000000000000, this is"):
        generate_scene_set(bracket, replace(spec, part_digest="0" * 64), tmp_path)
    with pytest.raises(ValueError, match="workers must be at least 1, got 0"):
        generate_scene_set(bracket, spec, tmp_path, workers=0)
    (tmp_path / "manifest.json").write_text("{")
    with pytest.raises(ValueError, match=r"manifest.json must be the manifest of a scene set, but it cannot be read"):
        SceneSet.open(tmp_path)
    assert not (tmp_path / "cycles").exists()


def test_an_interrupted_set_is_not_opened_and_goes_on(
    bracket: Part, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = make_spec(bracket)
    expected = generate_scene_set(bracket, spec, tmp_path / "whole", progress=False).digest
    simulate, directory, cycles = scene_set.simulate_cycle, tmp_path / "half", []

    def interrupted(*args: object) -> list[SceneRecord]:
        if len(cycles) == 2:
            raise KeyboardInterrupt
        cycles.append(args[-1])
        return simulate(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(cycle_pool, "simulate_cycle", interrupted)
    with pytest.raises(KeyboardInterrupt):
        generate_scene_set(bracket, spec, directory, progress=False)
    with pytest.raises(ValueError, match="must hold a complete scene set, but it was interrupted"):
        SceneSet.open(directory)
    assert json.loads((directory / "manifest.json").read_text())["content_digest"] is None
    (directory / "cycles" / ".00002.npz.999").write_bytes(b"half a file of a killed process")
    cycles.clear()
    monkeypatch.setattr(cycle_pool, "simulate_cycle", lambda *a: (cycles.append(a[-1]), simulate(*a))[1])
    assert generate_scene_set(bracket, spec, directory, progress=False).digest == expected
    assert cycles == [2, 3]
    assert not list(directory.rglob(".0*"))


# The rest runs real processes and kills them.

SCRIPT = """
import pickle, sys
from pathlib import Path
from attentionvote.simulation import cycle, scene_set
if __name__ == "__main__":
    part, hulls, spec, directory = pickle.loads(Path(sys.argv[1]).read_bytes())
    cycle.convex_hulls = lambda *_, **__: hulls
    scene_set.generate_scene_set(part, spec, directory, workers=2)
"""


def start(part: Part, hulls: tuple, spec: SceneSetSpec, directory: Path) -> subprocess.Popen:
    script, job = directory.parent / "job.py", directory.parent / "job.pkl"
    script.write_text(SCRIPT)
    job.write_bytes(pickle.dumps((part, hulls, spec, directory)))
    return subprocess.Popen(
        [sys.executable, script, job], start_new_session=True, stderr=subprocess.PIPE, stdout=subprocess.PIPE
    )


def wait_for_shards(directory: Path, count: int, process: subprocess.Popen) -> None:
    deadline = time.monotonic() + 60
    while len(list(directory.glob("cycles/0*.npz"))) < count:
        assert process.poll() is None, "finished before it could be interrupted"
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.slow
def test_killed_and_continued_is_the_same_set(bracket: Part, hulls: tuple, tmp_path: Path) -> None:
    spec, directory = make_spec(bracket, cycles=30), tmp_path / "set"
    process = start(bracket, hulls, spec, directory)
    try:
        wait_for_shards(directory, 3, process)
    finally:
        process.kill()
        process.communicate()
    # The workers follow their parent; they are the only others that could still write.
    count = len(list(directory.glob("cycles/0*.npz")))
    time.sleep(1.5)
    settled = len(list(directory.glob("cycles/0*.npz")))
    assert settled <= count + 2
    assert settled < 30
    resumed = generate_scene_set(bracket, spec, directory, workers=2, progress=False)
    whole = generate_scene_set(bracket, spec, tmp_path / "whole", workers=1, progress=False)
    assert resumed.digest == whole.digest


@pytest.mark.slow
def test_ctrl_c_leaves_nothing_half_written(bracket: Part, hulls: tuple, tmp_path: Path) -> None:
    spec, directory = make_spec(bracket, cycles=200), tmp_path / "set"
    process = start(bracket, hulls, spec, directory)
    wait_for_shards(directory, 3, process)
    began = time.monotonic()
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to every process of the group
    _, err = process.communicate(timeout=30)
    assert time.monotonic() - began < 10
    assert process.returncode != 0
    assert err.decode().count("KeyboardInterrupt") <= 2  # the parent's own, none from the workers
    for shard in directory.glob("cycles/0*.npz"):
        assert scene_set.load_records(shard)
    assert not SceneSet.is_complete(directory)


@pytest.mark.slow
def test_the_cycle_of_a_killed_worker_is_done_again(
    bracket: Part, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec, directory = make_spec(bracket, cycles=60), tmp_path / "set"
    before = set(multiprocessing.active_children())
    killed, stored, save = [], [], scene_set.save_records
    monkeypatch.setattr(scene_set, "save_records", lambda *a: (stored.append(int(a[0].stem)), save(*a)))

    def kill_one() -> None:
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline and not list(directory.glob("cycles/0*.npz")):
            time.sleep(0.01)
        killed.append(len(list(directory.glob("cycles/0*.npz"))))
        worker = next(iter(set(multiprocessing.active_children()) - before))
        os.kill(worker.pid, signal.SIGKILL)  # type: ignore[arg-type]

    killer = threading.Thread(target=kill_one)
    killer.start()
    scenes = generate_scene_set(bracket, spec, directory, workers=2, progress=False)
    killer.join()
    assert killed[0] < 60
    assert sorted(stored) == list(range(60))  # nothing twice
    assert set(multiprocessing.active_children()) <= before
    assert scenes.digest == generate_scene_set(bracket, spec, tmp_path / "one", progress=False).digest
