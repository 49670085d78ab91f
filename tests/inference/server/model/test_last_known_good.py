"""The copies on disk: two, whole, newest first, whatever happens while they are made."""

from __future__ import annotations

import itertools
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from attentionvote.inference.bundles.bundle import Bundle, load_bundle
from attentionvote.inference.errors import BundleError, InputError
from attentionvote.inference.fetching.reference import parse_reference
from attentionvote.inference.server.model import last_known_good
from attentionvote.inference.server.model.last_known_good import LastKnownGood, default_state

Make = Callable[..., Path]


@pytest.fixture
def store(tmp_path: Path) -> Iterator[LastKnownGood]:
    """An empty store."""
    made = LastKnownGood(tmp_path / "state")
    yield made
    made.close()


@pytest.fixture
def bundles(make_bundle: Make, trusted_key: Path) -> list[Bundle]:
    """Three bundles of different digests."""
    folders = [make_bundle(f"b{i}", graph={"confidence": (0.7, 0.9 + i / 100, 0.3, 0.99)}) for i in range(3)]
    return [load_bundle(folder, trusted_key) for folder in folders]


def digests(store: LastKnownGood, key: Path) -> list[str]:
    """Of the copies, newest first; each is loaded, so it is whole."""
    return [load_bundle(entry, key).digest for entry in store.entries()]


def test_the_two_newest_are_kept_newest_first(store: LastKnownGood, bundles: list[Bundle], trusted_key: Path) -> None:
    assert store.entries() == []
    for bundle in bundles:
        store.keep(bundle.path, bundle, trusted_key)
    assert digests(store, trusted_key) == [bundles[2].digest, bundles[1].digest]
    assert [entry.name[:8] for entry in store.entries()] == ["00000003", "00000002"]
    assert sorted(p.name for p in store.folder.iterdir()) == ["kept", "lock"]


def test_what_serves_again_becomes_the_newest(store: LastKnownGood, bundles: list[Bundle], trusted_key: Path) -> None:
    first, second, _ = bundles
    for bundle in (first, second, second, first):
        store.keep(bundle.path, bundle, trusted_key)
    assert digests(store, trusted_key) == [first.digest, second.digest]
    assert [entry.name[:8] for entry in store.entries()] == ["00000003", "00000002"]


def test_a_damaged_copy_of_the_same_bundle_is_replaced(
    store: LastKnownGood, bundles: list[Bundle], trusted_key: Path
) -> None:
    for bundle in bundles[:2]:
        store.keep(bundle.path, bundle, trusted_key)
    (store.entries()[0] / "model.onnx").write_bytes(b"rot")
    store.keep(bundles[1].path, bundles[1], trusted_key)
    assert digests(store, trusted_key) == [bundles[1].digest, bundles[0].digest]


def test_what_changed_since_it_was_loaded_is_not_kept(
    store: LastKnownGood, bundles: list[Bundle], trusted_key: Path
) -> None:
    store.keep(bundles[0].path, bundles[0], trusted_key)
    with pytest.raises(OSError, match="was exchanged while it was copied"):
        store.keep(bundles[2].path, bundles[1], trusted_key)
    os.truncate(bundles[1].path / "model.onnx", 10)
    with pytest.raises(BundleError, match=r"model\.onnx must have"):
        store.keep(bundles[1].path, bundles[1], trusted_key)
    assert digests(store, trusted_key) == [bundles[0].digest]
    assert not list(store.folder.glob("staging-*"))


def test_a_folder_belongs_to_one_server(store: LastKnownGood) -> None:
    with pytest.raises(InputError, match="must belong to one server, but another one that runs holds it"):
        LastKnownGood(store.folder)


def test_what_a_killed_server_left_is_removed(store: LastKnownGood) -> None:
    (store.folder / "staging-x").mkdir()
    (store.folder / "staging-x" / "model.onnx").write_bytes(b"half")
    store.close()
    again = LastKnownGood(store.folder)
    assert not list(again.folder.glob("staging-*"))
    store._lock = os.dup(again._lock)  # closed once more by the fixture
    again.close()


def test_foreign_names_are_no_copies(store: LastKnownGood) -> None:
    for name in ("00000009", "x-3fa9c1d2e4b5", "00000009-3FA9C1D2E4B5", ".hidden"):
        (store.folder / "kept" / name).mkdir()
    assert store.entries() == []


def test_killed_at_any_moment_every_copy_is_whole(tmp_path: Path, bundles: list[Bundle], trusted_key: Path) -> None:
    """A child keeps three bundles in turn and is killed with -9, at forty different moments."""
    folder = tmp_path / "killed"
    rng = np.random.default_rng(0)
    seen = set()
    for i in range(40):
        child = os.fork()
        if child == 0:
            try:
                store = LastKnownGood(folder)
                for k in itertools.count(i):
                    store.keep(bundles[k % 3].path, bundles[k % 3], trusted_key)
            finally:
                os._exit(1)  # reached by an error only
        time.sleep(float(rng.uniform(0.002, 0.08)))
        os.kill(child, signal.SIGKILL)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
        store = LastKnownGood(folder)
        found = digests(store, trusted_key)  # raises for half a copy
        store.close()
        assert len(found) <= 3  # a third one when it was killed before the oldest went
        if seen:
            assert found  # what was there once is never lost
        seen.update(found)
    assert len(seen) == 3


def test_a_path_has_its_own_state_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("ATTENTIONVOTE_STATE", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "real").mkdir()
    (tmp_path / "latest").symlink_to(tmp_path / "real")
    latest = default_state(Path("latest"))
    assert latest.parent == tmp_path
    assert latest.name.startswith("latest-")
    assert default_state(tmp_path / "latest") == latest  # by name, not by what it leads to
    assert default_state(tmp_path / "real") != latest
    assert default_state(Path("/")).name.startswith("bundle-")
    champion = default_state(parse_reference("models:/attentionvote-gear@champion"))
    assert champion.name.startswith("attentionvote-gear_champion-")
    assert default_state(parse_reference("models:/attentionvote-gear/3")) != champion
    monkeypatch.chdir(tmp_path)  # a reference is the same wherever the server is started
    assert default_state(parse_reference("models:/attentionvote-gear@champion")) == champion
    monkeypatch.delenv("ATTENTIONVOTE_STATE")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert default_state(Path("latest")).parent == tmp_path / "home" / ".local" / "state" / "attentionvote"


def test_files_reach_the_disk_before_their_name(
    store: LastKnownGood, bundles: list[Bundle], trusted_key: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The order of calls to the system: every file and folder is synced before the copy gets its name."""
    calls: list[str] = []
    fsync, rename = os.fsync, os.rename

    def synced(handle: int) -> None:
        calls.append(f"sync {os.path.basename(os.readlink(f'/proc/self/fd/{handle}'))}")
        fsync(handle)

    def renamed(source: Path, target: Path) -> None:
        calls.append(f"name {target.name[9:]}")
        rename(source, target)

    monkeypatch.setattr(last_known_good.os, "fsync", synced)
    monkeypatch.setattr(last_known_good.os, "rename", renamed)
    store.keep(bundles[0].path, bundles[0], trusted_key)
    at = calls.index(f"name {bundles[0].digest[:12]}")
    for name in ("model.onnx", "card.json", "manifest.json", "manifest.sig", "part.ply", "cloud_0.npz", "golden"):
        assert calls.index(f"sync {name}") < at
    assert any(call.startswith("sync staging-") for call in calls[:at])
    assert calls[at + 1 :] == ["sync kept"]
