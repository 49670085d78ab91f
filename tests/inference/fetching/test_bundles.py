"""Fetching from a real registry: whole and signed or nothing, not twice, killed in the middle, old ones forgotten."""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from attentionvote.inference.bundles.bundle import load_bundle
from attentionvote.inference.bundles.signature import load_public_key, make_keys
from attentionvote.inference.errors import BundleError, RegistryError
from attentionvote.inference.fetching.access import Access
from attentionvote.inference.fetching.bundles import FetchedBundles
from attentionvote.inference.fetching.reference import RegistryVersion, parse_reference
from attentionvote.inference.fetching.registry import Registry

Make = Callable[..., Path]
pytestmark = pytest.mark.slow  # the first one starts an MLflow server


class Cell:
    """A folder of fetched bundles, opened for one reference."""

    def __init__(self, folder: Path, url: str, reference: str, key: Path) -> None:
        self.folder, self.reference = folder, parse_reference(reference)
        self.bundles = FetchedBundles(folder, self.reference, load_public_key(key))
        self.registry = Registry(Access(url))

    def take(self, *serving: str) -> tuple[Path, bool]:
        """What the reference names now."""
        return self.bundles.take(self.registry, self.registry.resolve(self.reference), serving)

    def names(self) -> set[str]:
        """What lies in the folder."""
        return {path.name for path in self.folder.iterdir()} - {"lock", "registry.json"}


def digest(folder: Path) -> str:
    return load_bundle(folder, None).digest


def same_files(one: Path, other: Path) -> bool:
    def content(folder: Path) -> dict[str, bytes]:
        return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}

    return content(one) == content(other)


@pytest.fixture
def three(real_registry: Any, make_bundle: Make) -> tuple[str, list[Path]]:
    """A model with three versions, the first is champion; its name, and the bundles."""
    name = real_registry.new_name()
    folders = [make_bundle(f"v{i}", card={"evaluation": {"ap": 0.7 + i / 100}}) for i in (1, 2, 3)]
    for folder in folders:
        real_registry.register(name, folder, alias=None)
    real_registry.move(name, "champion", "1")
    return name, folders


def test_a_bundle_arrives_whole_once_and_manifest_and_signature_first(
    gate: Any, three: Any, trusted_key: Path, tmp_path: Path
) -> None:
    name, folders = three
    cell = Cell(tmp_path / "cell", gate.url, f"models:/{name}@champion", trusted_key)
    folder, fetched = cell.take()
    assert fetched
    assert same_files(folder, folders[0])
    assert cell.names() == {"latest", digest(folders[0])[:12]}
    assert os.readlink(cell.bundles.link) == folder.name  # relative: the folder may be mounted elsewhere
    asked = gate.files()
    assert asked[:2] == ["manifest.json", "manifest.sig"]
    assert sorted(asked) == sorted(p.relative_to(folders[0]).as_posix() for p in folders[0].rglob("*") if p.is_file())
    assert cell.take() == (folder, False)
    again = Cell(tmp_path / "cell", gate.url, f"models:/{name}@champion", trusted_key)  # another process
    assert again.take() == (folder, False)
    assert gate.files() == asked


def test_current_and_previous_are_kept_and_a_rollback_fetches_nothing(
    real_registry: Any, three: Any, trusted_key: Path, tmp_path: Path
) -> None:
    name, folders = three
    cell = Cell(tmp_path / "cell", real_registry.url, f"models:/{name}@champion", trusted_key)
    (tmp_path / "cell" / "somebody").mkdir()  # not fetched: not ours to remove
    short = [digest(folder)[:12] for folder in folders]
    cell.take()
    for version, expected in (("2", {0, 1}), ("3", {1, 2}), ("2", {1, 2}), ("1", {0, 1})):
        real_registry.move(name, "champion", version)
        _, fetched = cell.take()
        assert cell.names() == {"latest", "somebody", *(short[i] for i in expected)}
        assert os.readlink(cell.bundles.link) == short[int(version) - 1]
        if version == "2":
            assert fetched == (expected == {0, 1})
    real_registry.move(name, "champion", "3")
    cell.take(digest(folders[1]))  # what serves is kept as well
    assert cell.names() == {"latest", "somebody", *short}


def test_a_pin_is_what_it_was_and_needs_no_alias(
    real_registry: Any, three: Any, trusted_key: Path, tmp_path: Path
) -> None:
    name, folders = three
    pin = Cell(tmp_path / "cell", real_registry.url, f"models:/{name}/2", trusted_key)
    assert pin.bundles.pinned() is None
    folder, _ = pin.take()
    real_registry.move(name, "champion", "3")
    expected = RegistryVersion(name, "2", digest(folders[1]))
    assert pin.bundles.pinned() == expected
    assert pin.take() == (folder, False)
    assert pin.bundles.origin_of(digest(folders[0])) is None
    # The same number of a model that was deleted and made again.
    with pytest.raises(BundleError, match=f"must be the bundle {expected.digest[:12]} that it was when"):
        pin.bundles.take(pin.registry, expected._replace(digest=digest(folders[0])))
    (folder / "part.ply").write_bytes(b"damaged")
    again = Cell(tmp_path / "cell", real_registry.url, f"models:/{name}/2", trusted_key)
    assert again.bundles.pinned() is None
    assert again.take() == (folder, True)
    assert same_files(folder, folders[1])


def test_each_reference_starts_from_its_own_bundles_only(
    real_registry: Any, three: Any, trusted_key: Path, tmp_path: Path
) -> None:
    name, folders = three
    url, state = real_registry.url, tmp_path / "cell"
    real_registry.move(name, "champion", "2")
    Cell(state, url, f"models:/{name}@champion", trusted_key).take()
    short = [digest(folder)[:12] for folder in folders]
    for reference, expected in (
        (f"models:/{name}@champion", short[1]),
        (f"models:/{name}/2", short[1]),  # an alias named it before: the same version
        (f"models:/{name}/1", None),
        (f"models:/{name}@other", None),
        ("models:/another/2", None),
    ):
        cell = Cell(state, "http://127.0.0.1:9", reference, trusted_key)
        cell.bundles.restore()
        assert (os.readlink(cell.bundles.link) if cell.bundles.link.is_symlink() else None) == expected
        assert (cell.bundles.origin_of(digest(folders[1])) is not None) == (expected is not None)


@pytest.mark.parametrize("record", [b"", b"{}", b'{"format": 2, "bundles": []}', b'{"format": 1, "bundles": [3]}'])
def test_a_damaged_record_is_none(
    real_registry: Any, three: Any, trusted_key: Path, tmp_path: Path, record: bytes
) -> None:
    cell = Cell(tmp_path / "cell", real_registry.url, f"models:/{three[0]}@champion", trusted_key)
    cell.take()
    (tmp_path / "cell" / "registry.json").write_bytes(record)
    again = Cell(tmp_path / "cell", real_registry.url, f"models:/{three[0]}@champion", trusted_key)
    again.bundles.restore()
    assert not again.bundles.link.exists()
    assert again.take()[1] is False  # the bundle is whole, only nobody knew what it was
    assert again.bundles.link.is_dir()


def unchanged(cell: Cell, before: set[str], link: str) -> None:
    assert cell.names() == before
    assert os.readlink(cell.bundles.link) == link


def test_what_is_bad_never_replaces_what_is_there(
    gate: Any, real_registry: Any, three: Any, trusted_key: Path, tmp_path: Path
) -> None:
    name, folders = three
    cell = Cell(tmp_path / "cell", gate.url, f"models:/{name}@champion", trusted_key)
    folder, _ = cell.take()
    before = cell.names()
    real_registry.move(name, "champion", "2")
    size = (folders[1] / "model.onnx").stat().st_size
    flipped = bytearray((folders[1] / "model.onnx").read_bytes())
    flipped[100] ^= 1
    manifest = json.loads((folders[1] / "manifest.json").read_bytes())
    manifest["files"]["model.onnx"]["bytes"] += 1
    for file, content, sentence, most_asked in (
        ("manifest.json", json.dumps(manifest).encode(), "does not fit the manifest, so the bundle was changed", 2),
        ("manifest.json", b" " * (1024 * 1024 + 1), "manifest.json must have at most 1048576 bytes, got more", 1),
        ("manifest.sig", b"{}", "signature file must be", 2),
        ("manifest.json", (folders[2] / "manifest.json").read_bytes(), "does not fit the manifest", 2),
        ("model.onnx", bytes(flipped), "model.onnx must have the sha256", 99),
        ("model.onnx", bytes(flipped) * 1000, f"model.onnx must have at most {size} bytes, got more", 99),
        ("model.onnx", bytes(flipped[:-1]), f"model.onnx must have {size} bytes, got {size - 1}", 99),
    ):
        gate.asked.clear()
        gate.change = lambda path, body, file=file, content=content: content if path.endswith(file) else body
        with pytest.raises(BundleError, match=re.escape(sentence)) as caught:
            cell.take()
        assert f"version 2 of {name}" in str(caught.value)
        assert len(gate.files()) <= most_asked, "nothing is fetched before somebody trusted has signed for it"
        unchanged(cell, before, folder.name)
    gate.change = lambda path, body: (folders[2] / path.rpartition("=")[2]).read_bytes() if "manifest" in path else body
    with pytest.raises(BundleError, match=f"must be the bundle {digest(folders[1])[:12]} of its tag, but"):
        cell.take()  # whole and signed, but not what the registry said
    unchanged(cell, before, folder.name)
    gate.change = None
    strange = Cell(tmp_path / "strange", gate.url, f"models:/{name}@champion", make_keys(tmp_path / "keys")[1])
    gate.asked.clear()
    with pytest.raises(BundleError, match="must be signed by the trusted key"):
        strange.take()
    assert gate.files() == ["manifest.json", "manifest.sig"]
    assert strange.names() == set()
    assert cell.take()[1]


def test_a_model_of_another_part_is_refused(
    real_registry: Any, make_bundle: Make, trusted_key: Path, tmp_path: Path
) -> None:
    real_registry.register("attentionvote-gear", make_bundle())
    cell = Cell(tmp_path / "cell", real_registry.url, "models:/attentionvote-gear@champion", trusted_key)
    with pytest.raises(BundleError, match="1 of attentionvote-gear must hold a model of gear, got one of bracket"):
        cell.take()
    assert cell.names() == set()


def test_a_registry_that_goes_away_in_the_middle_leaves_nothing(
    gate: Any, three: Any, trusted_key: Path, tmp_path: Path
) -> None:
    cell = Cell(tmp_path / "cell", gate.url, f"models:/{three[0]}@champion", trusted_key)
    gate.stop_after = lambda path: 1000 if path.endswith("model.onnx") else None
    gate.cut = True
    with pytest.raises(RegistryError, match="ended an answer before it was whole"):
        cell.take()
    assert cell.names() == set()


def test_a_full_disk_leaves_nothing(real_registry: Any, three: Any, trusted_key: Path, tmp_path: Path) -> None:
    cell = Cell(tmp_path / "cell", real_registry.url, f"models:/{three[0]}@champion", trusted_key)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, hard))  # the write fails as on a full disk, with another number
    try:
        with pytest.raises(OSError, match="File too large"):
            cell.take()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, handler)
    assert cell.names() == set()
    assert cell.take()[1]


def test_killed_in_the_middle_nothing_half_is_left_and_the_next_one_cleans_up(
    gate: Any, real_registry: Any, three: Any, trusted_key: Path, tmp_path: Path
) -> None:
    name, folders = three
    cell = Cell(tmp_path / "cell", real_registry.url, f"models:/{name}@champion", trusted_key)
    folder, _ = cell.take()
    real_registry.move(name, "champion", "2")
    gate.stop_after = lambda path: 1000 if path.endswith("model.onnx") else None
    words = ["fetch", f"models:/{name}@champion", "--registry", gate.url, "--to", cell.folder, "--key", trusted_key]
    command = [sys.executable, "-m", "attentionvote.inference.command_line", *map(str, words)]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    assert gate.stopped.wait(30)
    process.kill()
    process.wait(10)
    left = cell.names() - {"latest", folder.name}
    assert len(left) == 1
    assert left.pop().startswith("fetching-")
    assert os.readlink(cell.bundles.link) == folder.name
    assert load_bundle(cell.bundles.link, trusted_key).digest == digest(folders[0])
    gate.go_on.set()
    taken, fetched = cell.take()
    assert fetched
    assert same_files(taken, folders[1])
    assert cell.names() == {"latest", folder.name, taken.name}


def test_two_processes_at_once_fetch_once(gate: Any, three: Any, trusted_key: Path, tmp_path: Path) -> None:
    name, folders = three
    gate.stop_after = lambda path: 1000 if path.endswith("model.onnx") else None
    to = tmp_path / "cell"
    words = ["fetch", f"models:/{name}@champion", "--registry", gate.url, "--to", to, "--key", trusted_key]
    command = [sys.executable, "-m", "attentionvote.inference.command_line", *map(str, words)]
    first = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert gate.stopped.wait(30)
    second = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    with pytest.raises(subprocess.TimeoutExpired):
        second.wait(2)
    gate.go_on.set()
    said = [process.communicate(timeout=30) for process in (first, second)]
    assert [process.returncode for process in (first, second)] == [0, 0]
    assert {out for out, _ in said} == {f"{to / digest(folders[0])[:12]}\n"}
    assert "fetched and verified" in said[0][1]
    assert "already there and verified" in said[1][1]
    assert gate.files().count("model.onnx") == 1
    shutil.rmtree(to)
