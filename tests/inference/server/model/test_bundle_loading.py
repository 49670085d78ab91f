"""When a folder is worth another try."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from attentionvote.inference.bundles.bundle import Bundle, Trusted, load_bundle
from attentionvote.inference.errors import BundleError
from attentionvote.inference.server.model.bundle_loading import BundleLoader, mark_of
from attentionvote.inference.server.model.last_known_good import LastKnownGood
from attentionvote.inference.server.worker.process import WorkerSettings
from attentionvote.inference.server.worker.workers import Workers


def test_a_mark_changes_with_anything_in_the_folder(bundle_folder: Path, trusted_key: Path, tmp_path: Path) -> None:
    mark = mark_of(bundle_folder)
    assert mark.digest == load_bundle(bundle_folder, trusted_key).digest
    assert mark == mark_of(bundle_folder)
    link = tmp_path / "latest"
    link.symlink_to(bundle_folder)
    assert mark_of(link) == mark
    for change in (
        lambda: os.utime(bundle_folder / "golden" / "cloud_0.npz", ns=(1, 1)),
        lambda: (bundle_folder / "extra").write_text("x"),
        lambda: os.truncate(bundle_folder / "model.onnx", 10),
        lambda: (bundle_folder / "manifest.json").write_text("{}"),
        lambda: (bundle_folder / "manifest.json").unlink(),
        lambda: shutil.rmtree(bundle_folder),
    ):
        change()
        assert mark_of(bundle_folder) != mark
        mark = mark_of(bundle_folder)
    assert mark.digest == ""


def test_a_served_model_was_verified_and_tested(bundle_folder: Path, trusted_key: Path) -> None:
    loader = BundleLoader(trusted_key, lambda bundle, _: Workers(bundle, WorkerSettings()), None)
    served, failure = loader.from_source(bundle_folder, must_keep=True)
    assert failure is None
    assert not served.saved  # there is no store
    served.workers.close()
    assert (served.name, served.version) == ("bracket", served.digest[:12])
    assert loader.last_known_good() == (None, [])
    with (bundle_folder / "model.onnx").open("ab") as file:
        file.write(b"x")
    with pytest.raises(BundleError, match=r"model\.onnx must have .* bytes"):
        loader.from_source(bundle_folder, must_keep=False)


def test_workers_that_may_not_serve_are_closed(bundle_folder: Path, trusted_key: Path, tmp_path: Path) -> None:
    """The folder changes after the self-test and before its copy is made."""
    started: list[Workers] = []

    class Changing(LastKnownGood):
        def keep(self, source: Path, bundle: Bundle, trusted: Trusted) -> None:
            (source / "extra").write_text("x")
            super().keep(source, bundle, trusted)

    def start(bundle: Bundle, _: bool) -> Workers:
        started.append(Workers(bundle, WorkerSettings()))
        return started[-1]

    store = Changing(tmp_path / "state")
    with pytest.raises(BundleError, match="extra is not in"):
        BundleLoader(trusted_key, start, store).from_source(bundle_folder, must_keep=True)
    assert not started[0].available
    store.close()
