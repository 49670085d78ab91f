"""Storing files: replacement, and stores that fail for a while."""

import logging
import shutil
from pathlib import Path

import pytest

from attentionvote.tracking.artifact_writer import ArtifactWriter, check_artifact_name, local_folder


class NoClient:
    """A local store needs no client; a call would be an error."""


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "mlartifacts" / "run" / "artifacts"


@pytest.fixture
def writer(folder):
    writer = ArtifactWriter(NoClient(), "run", folder.as_uri(), retry_s=0.05)
    yield writer
    writer.close(1.0)


def test_newer_file_replaces_the_older_and_nothing_else_stays(writer, folder, tmp_path):
    source = tmp_path / "epoch.ckpt"
    for content in (b"one", b"two", b"three"):
        source.write_bytes(content)
        writer.put_file(source, "checkpoints/last.ckpt")
        source.unlink()  # as Lightning does with the older of its best
        assert writer.flush(10)
    assert [p.read_bytes() for p in folder.rglob("*") if p.is_file()] == [b"three"]
    assert writer.close(1.0) == []
    assert [p.name for p in (tmp_path / "mlartifacts").iterdir()] == ["run"]


def test_failure_warns_once_and_is_made_good_later(writer, folder, caplog):
    caplog.set_level(logging.WARNING)
    folder.parent.mkdir(parents=True)
    folder.write_text("in the way, like a full disk")
    for content in (b"one", b"two"):
        writer.put_bytes(content, "a.txt")
        assert not writer.flush(0.3)
    assert caplog.text.count("could not be stored") == 1
    folder.unlink()
    assert writer.flush(10)
    assert (folder / "a.txt").read_bytes() == b"two"
    assert "can be stored again" in caplog.text


def test_file_that_cannot_be_staged_is_taken_up_later(writer, folder, tmp_path, caplog):
    source = tmp_path / "last.ckpt"
    source.write_bytes(b"weights")
    staging = tmp_path / "mlartifacts/.staging-run"
    shutil.rmtree(staging, ignore_errors=True)
    staging.parent.mkdir(exist_ok=True)
    staging.write_text("in the way")
    writer.put_file(source, "checkpoints/last.ckpt")
    assert "could not be stored" in caplog.text
    assert not writer.flush(0.1)
    staging.unlink()
    assert writer.flush(10)
    assert (folder / "checkpoints/last.ckpt").read_bytes() == b"weights"


def test_close_names_what_is_lost(writer, folder):
    folder.parent.mkdir(parents=True)
    folder.write_text("in the way")
    writer.put_bytes(b"x", "a.txt")
    assert writer.close(0.2) == ["a.txt"]


@pytest.mark.parametrize("name", ["", "/etc/passwd", "../other", "a/../../b"])
def test_names_stay_inside_the_run(name):
    with pytest.raises(ValueError, match="must be a relative path inside the run"):
        check_artifact_name(name)


@pytest.mark.parametrize(
    ("uri", "folder"),
    [
        ("file:///a%20b/run/artifacts", "/a b/run/artifacts"),
        ("/a b/run/artifacts", "/a b/run/artifacts"),
        ("mlflow-artifacts:/1/run/artifacts", None),
        ("s3://bucket/1/run/artifacts", None),
    ],
)
def test_local_folder_is_none_for_what_a_server_keeps(uri, folder):
    assert local_folder(uri) == (folder and Path(folder))
