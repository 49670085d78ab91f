"""Files that survive a kill: whole or not at all, one process a folder, one cache folder."""

from __future__ import annotations

import errno
import os
import pickle
import re
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from real_disks import read_only, small_disk

from attentionvote.files import (
    DiskFull,
    FolderUnavailable,
    cache_folder,
    disk_full,
    is_locked,
    locked_folder,
    naming_full_disk,
    read_json,
    remove_folder,
    remove_leftovers,
    waiting_lock,
    whole,
    write_json,
    write_whole,
)


def test_a_file_is_written_whole_or_stays_what_it_was(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.txt"
    write_whole(path, "one\r\n")
    assert path.read_bytes() == b"one\r\n"

    def half(temporary: Path) -> None:
        assert temporary.suffix == ".txt"
        temporary.write_text("ha")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        whole(path, half)
    assert path.read_bytes() == b"one\r\n"
    assert [entry.name for entry in path.parent.iterdir()] == ["a.txt"]


def test_leftovers_of_one_file_are_removed_and_no_other(tmp_path: Path) -> None:
    for name in (".last.7.ckpt", ".last.ckpt.7", "last.ckpt", ".best.7.ckpt", "last.7.ckpt"):
        (tmp_path / name).touch()
    remove_leftovers(tmp_path / "last.ckpt")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == [".best.7.ckpt", "last.7.ckpt", "last.ckpt"]


def test_json_that_is_damaged_is_passed_over(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "a.json"
    assert read_json(path) is None
    write_json(path, {"a": 1})
    assert read_json(path) == {"a": 1}
    assert not caplog.records
    for damaged in ("{", "[1]"):
        path.write_text(damaged)
        assert read_json(path) is None
    assert caplog.messages == [f"{path} is damaged and is passed over"] * 2


def test_one_process_a_folder_and_a_killed_one_leaves_it_free(tmp_path: Path) -> None:
    program = (
        "import sys, time; from pathlib import Path; from attentionvote.files import locked_folder\n"
        "with locked_folder(Path(sys.argv[1]), 'x', 'training'): print('in', flush=True); time.sleep(60)"
    )
    folder = tmp_path / "results"
    assert not is_locked(folder)
    other = subprocess.Popen([sys.executable, "-c", program, str(folder)], stdout=subprocess.PIPE)
    assert other.stdout is not None
    assert other.stdout.readline() == b"in\n"
    assert is_locked(folder)
    with (
        pytest.raises(FolderUnavailable, match="another process is at this training"),
        locked_folder(folder, "x", "training"),
    ):
        pass
    other.kill()
    other.wait()
    other.stdout.close()
    assert not is_locked(folder)
    with locked_folder(folder, "x", "training"):
        assert is_locked(folder)


def test_a_folder_that_cannot_be_made_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with (
        pytest.raises(FolderUnavailable, match=r"^outputs=here cannot be written: Not a directory$"),
        locked_folder(tmp_path / "file" / "x", "here", "training"),
    ):
        pass


def test_who_waits_for_a_lock_comes_after_whoever_has_it(tmp_path: Path) -> None:
    order = []

    def second() -> None:
        with waiting_lock(tmp_path / "new" / ".lock"):
            order.append("second")

    with waiting_lock(tmp_path / "new" / ".lock"):
        thread = threading.Thread(target=second)
        thread.start()
        thread.join(0.2)
        order.append("first")
    thread.join(10)
    assert order == ["first", "second"]


def test_one_cache_folder_for_everything(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("ATTENTIONVOTE_CACHE", "")  # not the current folder
    assert cache_folder() == tmp_path / ".cache" / "attentionvote"
    monkeypatch.setenv("XDG_CACHE_HOME", "/x")
    assert cache_folder() == Path("/x/attentionvote")
    monkeypatch.setenv("ATTENTIONVOTE_CACHE", "/y")
    assert cache_folder() == Path("/y")
    assert os.environ["ATTENTIONVOTE_CACHE"] == "/y"


FULL = (
    r"^the disk of {} must have room, but [\d,]+ bytes are free \({}\): make room, the same command goes on from there$"
)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_a_sentence_with_the_folder(tmp_path: Path, number: int) -> None:
    def full(_: Path) -> None:
        raise OSError(number, os.strerror(number))

    with pytest.raises(DiskFull, match=FULL.format(tmp_path, os.strerror(number))) as error:
        whole(tmp_path / "a", full)
    assert error.value.errno == number
    again = pickle.loads(pickle.dumps(error.value))  # of a worker
    assert (type(again), str(again)) == (DiskFull, str(error.value))
    assert disk_full(again) is again
    assert not list(tmp_path.iterdir())


def test_other_errors_are_left_as_they_are(tmp_path: Path) -> None:
    with pytest.raises(IsADirectoryError), naming_full_disk(tmp_path):
        tmp_path.write_text("")
    assert disk_full(OSError("disk full")) is None
    assert disk_full(ValueError("28")) is None


def test_the_folder_is_the_one_that_the_error_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "outputs").mkdir()
    number, text = errno.ENOSPC, os.strerror(errno.ENOSPC)
    named = [
        (OSError(number, text, str(tmp_path / "to" / "f")), tmp_path / "to"),
        (OSError(number, text, "/from/f", None, str(tmp_path / "to" / "f")), tmp_path / "to"),  # of a copy
        (OSError(number, text), r"(outputs|\.|/tmp)"),
    ]
    for error, folder in named:
        assert re.match(f"the disk of {folder} must have room", str(disk_full(error)))
    by_database = RuntimeError("(sqlite3.OperationalError) database or disk is full\n[SQL: ...]")
    assert "the disk of to must have room" in str(disk_full(by_database, Path("to")))
    assert disk_full(by_database) is None  # nobody can tell which


def test_a_disk_that_is_really_full(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", "64k") as disk:
        write_whole(disk / "before", "here")
        with pytest.raises(DiskFull, match=FULL.format(disk / "deep", "No space left on device")):
            write_whole(disk / "deep" / "a", "x" * 100_000)
        assert sorted(path.name for path in disk.rglob("*")) == ["before", "deep"]
        (disk / "rest").write_bytes(b"x" * 56 * 1024)
        for folder in (disk / "new", disk / "deep"):  # inodes need no room on this file system
            with locked_folder(folder, "x", "training"), waiting_lock(folder / "b"):
                pass


def test_a_place_for_reading_only_is_one_sentence(tmp_path: Path) -> None:
    with read_only(tmp_path):
        refused = pytest.raises(FolderUnavailable, match=rf"^{tmp_path} cannot be written: Read-only file system$")
        with refused, waiting_lock(tmp_path / ".lock"):
            pass
        assert not is_locked(tmp_path)


def test_a_folder_is_removed_with_what_a_killed_removal_left(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    for path in (folder, tmp_path / ".removed-set"):  # the second of a killed process
        path.mkdir()
        (path / "manifest.json").touch()
        (path / "data").touch()
    remove_folder(folder, "manifest.json")
    assert list(tmp_path.iterdir()) == []


def test_who_waits_for_the_lock_of_a_folder_that_is_removed_gets_a_new_one(tmp_path: Path) -> None:
    folder, entered = tmp_path / "set", []

    def second() -> None:
        with waiting_lock(folder / ".lock"):
            (folder / "made").touch()
            entered.append(is_locked(folder))

    with waiting_lock(folder / ".lock"):
        thread = threading.Thread(target=second)
        thread.start()
        thread.join(0.2)
        remove_folder(folder)
        assert not folder.exists()
    thread.join(10)
    assert entered == [True]
    assert (folder / "made").is_file()
