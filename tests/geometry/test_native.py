"""Compiling and loading the C files: what happens on machines where that cannot be done."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from attentionvote.geometry import native


@pytest.fixture
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A machine on which nothing has been compiled yet."""
    monkeypatch.setenv("ATTENTIONVOTE_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("CC", raising=False)
    native.compiled.cache_clear()
    yield tmp_path / "cache"
    native.compiled.cache_clear()


def test_a_library_is_compiled_once_and_kept(empty_cache: Path) -> None:
    if native.shutil.which("cc") is None:
        pytest.skip("no C compiler on this machine")
    assert native.load("attentionvote.geometry", "pointops.c") is not None
    (kept,) = empty_cache.glob("pointops-*.so")
    changed = kept.stat().st_mtime_ns
    native.compiled.cache_clear()
    assert native.load("attentionvote.geometry", "pointops.c") is not None
    assert kept.stat().st_mtime_ns == changed


def test_another_processor_has_a_library_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    def made(tuned: bool) -> tuple[Path, tuple[str, ...]]:
        return native._library("attentionvote.model", "pooled_mlp.c", tuned)[:2]

    monkeypatch.delenv("ATTENTIONVOTE_MARCH", raising=False)
    portable, (own, flags) = made(False), made(True)
    assert flags[-1] == "-march=native"
    monkeypatch.setenv("ATTENTIONVOTE_MARCH", "x86-64")
    other, flags = made(True)
    assert flags[-1] == "-march=x86-64"
    assert other != own
    assert made(False) == portable  # what a cell runs is the same on every processor


def test_a_library_made_elsewhere_needs_neither_compiler_nor_a_writable_folder(
    empty_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if native.shutil.which("cc") is None:
        pytest.skip("no C compiler on this machine")
    assert native.load("attentionvote.geometry", "pointops.c") is not None
    native.compiled.cache_clear()
    monkeypatch.setattr(native.shutil, "which", lambda _: None)
    monkeypatch.setattr(native, "_writable", lambda _: False)  # root may write anywhere
    empty_cache.chmod(0o555)
    try:
        before = sorted((p.name, p.stat().st_mtime_ns) for p in empty_cache.iterdir())
        assert native.load("attentionvote.geometry", "pointops.c") is not None
        assert sorted((p.name, p.stat().st_mtime_ns) for p in empty_cache.iterdir()) == before
    finally:
        empty_cache.chmod(0o755)


def test_a_cell_takes_what_was_made_before_and_makes_nothing(empty_cache: Path) -> None:
    assert native.load("attentionvote.geometry", "pointops.c", make=False) is None
    assert not empty_cache.exists()
    if native.shutil.which("cc") is not None:
        made = native.load("attentionvote.geometry", "pointops.c")
        assert native.load("attentionvote.geometry", "pointops.c", make=False) is made


@pytest.mark.usefixtures("empty_cache")
def test_without_a_compiler_there_is_no_library_and_one_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native.shutil, "which", lambda _: None)
    with pytest.warns(UserWarning, match=r"no C compiler found, pointops\.c is replaced by slow Python: install gcc"):
        assert native.load("attentionvote.geometry", "pointops.c") is None
    assert native.load("attentionvote.geometry", "pointops.c") is None  # remembered, no second warning


@pytest.mark.usefixtures("empty_cache")
def test_without_a_place_to_keep_it_there_is_no_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("ATTENTIONVOTE_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.warns(UserWarning, match="cannot be written.*set ATTENTIONVOTE_CACHE"):
        assert native.load("attentionvote.geometry", "pointops.c") is None


@pytest.mark.usefixtures("empty_cache")
def test_a_refused_file_is_reported_in_the_compilers_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "false")
    with pytest.raises(OSError, match="false could not compile pointops"):
        native.load("attentionvote.geometry", "pointops.c")


def test_a_function_without_memory_raises() -> None:
    class Failing:
        __name__ = "ball_query"

        def __call__(self, *_: object) -> int:
            return 1

    with pytest.raises(MemoryError, match="ball_query ran out of memory"):
        native.call(Failing())


@pytest.mark.parametrize(("answer", "served"), [(0, True), (2, False)])
def test_a_function_says_whether_it_serves(answer: int, served: bool) -> None:
    assert native.call(lambda *_: answer) is served  # type: ignore[arg-type]


def test_disabled_leaves_the_references_and_comes_back() -> None:
    before = native.load("attentionvote.geometry", "pointops.c")
    with native.disabled():
        assert native.load("attentionvote.geometry", "pointops.c") is None
        with native.disabled():
            assert native.load("attentionvote.geometry", "pointops.c") is None
        assert native.load("attentionvote.geometry", "pointops.c") is None
    assert native.load("attentionvote.geometry", "pointops.c") is before
