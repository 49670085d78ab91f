"""Git state of real repositories, cut patches, versions."""

import subprocess

from attentionvote.tracking.provenance import git_state, hardware, package_versions


def _git(folder, *words):
    identity = ["-c", "user.name=n", "-c", "user.email=e@example.org", "-c", "commit.gpgsign=false"]
    subprocess.run(["git", "-C", str(folder), *identity, *words], check=True, capture_output=True)


def test_git_state_has_the_changes_of_tracked_files_and_the_names_of_others(tmp_path):
    _git(tmp_path, "init")
    (tmp_path / "a.txt").write_text("old\n")
    _git(tmp_path, "add", "a.txt")
    _git(tmp_path, "commit", "-m", "first")
    clean = git_state(tmp_path)
    assert len(clean.commit) == 40
    assert not clean.is_dirty
    assert clean.label == clean.commit
    assert clean.patch == ""
    (tmp_path / "a.txt").write_text("new ä\n")
    (tmp_path / "b.txt").write_text("untracked\n")
    dirty = git_state(tmp_path)
    assert dirty.is_dirty
    assert dirty.label == f"{dirty.commit}+dirty"
    assert "-old\n+new ä\n" in dirty.patch
    assert "?? b.txt" in dirty.status
    (tmp_path / "a.txt").write_text("line\n" * 10_000)
    cut = git_state(tmp_path, patch_limit=1000).patch
    assert len(cut) < 1100
    assert "the first 1000 are kept" in cut


def test_git_state_outside_of_a_repository_is_unknown(tmp_path):
    state = git_state(tmp_path)
    assert (state.commit, state.is_dirty) == ("unknown", False)


def test_dirty_tree_is_stored_with_the_run(store, tmp_path):
    from attentionvote import tracking

    _git(tmp_path, "init")
    (tmp_path / "a.txt").write_text("old\n")
    _git(tmp_path, "add", "a.txt")
    _git(tmp_path, "commit", "-m", "first")
    (tmp_path / "a.txt").write_text("new\n")
    with tracking.start_run(store, "rod", repository=tmp_path, system_interval_s=0) as run:
        patch = run.download("uncommitted.patch", tmp_path / "out").read_text()
    assert "+new" in patch


def test_versions_and_hardware_are_filled():
    assert set(package_versions()) >= {"python", "torch", "mlflow", "numpy"}
    assert int(hardware()["cores"]) >= 1
    assert float(hardware()["memory_gib"]) > 0.1
