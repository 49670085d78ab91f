"""Git state of real repositories, whole and cut patches, versions."""

import json
import os
import subprocess

import pytest

from attentionvote.tracking.provenance import git_state, hardware, package_versions
from attentionvote.tracking.run_opening import start_run


def test_a_clean_tree_is_its_commit(work_tree):
    clean = git_state(work_tree)
    assert len(clean.commit) == 40
    assert (clean.is_dirty, clean.label, clean.patch, clean.patch_digest) == (False, clean.commit, "", "")


def test_the_patch_brings_the_commit_to_the_working_tree(work_tree, tmp_path):
    """Changed, new, deleted, staged and binary files; the work_tree itself is only read."""
    (work_tree / "a.txt").write_text("new ä\n")
    (work_tree / ".gitignore").write_text("ignored\n")
    (work_tree / "ignored").write_text("x")
    (work_tree / "conf").mkdir()
    (work_tree / "conf" / "my_part.yaml").write_text("name: my_part\n")
    (work_tree / "mesh.stl").write_bytes(bytes(range(256)))
    before = subprocess.check_output(["git", "-C", work_tree, "status", "--porcelain"])
    dirty = git_state(work_tree)
    assert subprocess.check_output(["git", "-C", work_tree, "status", "--porcelain"]) == before
    assert dirty.label == f"{dirty.commit}+dirty"
    assert "?? mesh.stl" in dirty.status
    blob = subprocess.check_output(["git", "-C", work_tree, "hash-object", "mesh.stl"], text=True).strip()
    assert f"{'0' * 40}..{blob}" in dirty.patch
    text = "".join(part for part in dirty.patch.split("diff --git")[1:] if "mesh.stl" not in part.split("\n")[0])
    assert "ignored\n" in text
    copy = tmp_path / "copy"
    subprocess.run(["git", "clone", "-q", work_tree, copy], check=True)
    whole = "".join("diff --git" + part for part in dirty.patch.split("diff --git")[1:] if "Binary" not in part)
    subprocess.run(["git", "-C", copy, "apply", "-"], input=whole.encode(), check=True)
    for name in ("a.txt", ".gitignore", "conf/my_part.yaml"):
        assert (copy / name).read_bytes() == (work_tree / name).read_bytes()
    assert len(dirty.patch_digest) == 64


def test_a_patch_that_is_cut_is_not_whole(work_tree):
    (work_tree / "a.txt").write_text("line\n" * 10_000)
    cut = git_state(work_tree, patch_limit=1000)
    assert len(cut.patch) < 1100
    assert "the first 1000 are kept" in cut.patch
    assert (cut.is_dirty, cut.is_whole, cut.patch_digest) == (True, False, "")


@pytest.mark.parametrize(
    ("setting", "name", "content", "whole"),
    [
        ("status.showUntrackedFiles=no", "new.txt", b"new\n", True),
        ("color.ui=always", "a.txt", b"new\n", True),
        ("diff.noprefix=true", "a.txt", b"new\n", True),
        ("core.bare=false", "a.txt", "ä\n".encode("latin-1"), False),  # a text cannot hold it
    ],
)
def test_the_users_settings_of_git_change_nothing(work_tree, setting, name, content, whole):
    key, _, value = setting.partition("=")
    subprocess.run(["git", "-C", work_tree, "config", key, value], check=True)
    (work_tree / name).write_bytes(content)
    state = git_state(work_tree)
    assert (state.is_dirty, state.is_whole) == (True, whole)
    assert f"diff --git a/{name} b/{name}\n" in state.patch


def test_a_change_within_the_second_of_the_commit_is_kept(work_tree):
    """Same size, same time as in the index: git compares the content only when the index is as old as the file."""
    file, index, second = work_tree / "a.txt", work_tree / ".git" / "index", (1_790_000_000, 1_790_000_000)
    os.utime(file, second)
    for words in (["config", "core.trustctime", "false"], ["update-index", "--refresh"]):
        subprocess.run(["git", "-C", work_tree, *words], check=True)
    os.utime(index, second)
    file.write_text("new\n")
    os.utime(file, second)
    state = git_state(work_tree)
    assert (state.is_dirty, state.is_whole) == (True, True)
    assert "+new" in state.patch


def test_git_state_outside_of_a_repository_is_unknown(tmp_path):
    state = git_state(tmp_path)
    assert (state.commit, state.is_dirty) == ("unknown", False)


def test_every_session_of_a_run_names_its_commit_and_keeps_its_changes(store, work_tree, tmp_path):
    with start_run(store, "rod", repository=work_tree, system_interval_s=0) as first:
        pass
    (work_tree / "a.txt").write_text("new\n")
    with start_run(store, "rod", run_id=first.id, repository=work_tree, system_interval_s=0) as run:
        patch = run.download("resume_1/uncommitted.patch", tmp_path / "out").read_text()
    assert "+new" in patch
    state = git_state(work_tree)
    assert (first.commit, run.commit) == (state.commit, state.label)
    from attentionvote.tracking.store import connect

    tags = connect(store).get_run(run.id).data.tags
    assert json.loads(tags["git.session_0"]) == {"commit": state.commit, "patch": ""}
    assert json.loads(tags["git.session_1"]) == {"commit": state.label, "patch": state.patch_digest}


def test_versions_and_hardware_are_filled():
    assert set(package_versions()) >= {"python", "torch", "mlflow", "numpy"}
    assert int(hardware()["cores"]) >= 1
    assert float(hardware()["memory_gib"]) > 0.1
