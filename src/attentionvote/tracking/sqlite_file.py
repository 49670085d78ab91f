"""An SQLite store as a file: its address, its tables made whole or not at all, a full disk."""

from __future__ import annotations

import contextlib
import os
import urllib.parse
from collections.abc import Iterator
from pathlib import Path

from attentionvote.files import disk_full, remove_leftovers, whole


def sqlite_uri(path: Path) -> str:
    """The address of a file, whatever its path holds: what SQLAlchemy takes for the file again."""
    text = os.fspath(path.expanduser().absolute())
    for letter in "%?#":  # first the % of the others
        text = text.replace(letter, f"%{ord(letter):02X}")
    return f"sqlite:///{text}"


def check_encoding(store: str, path: str) -> None:
    """Refuse a path that is there as it stands: SQLAlchemy would write into another file, without a word.

    Args:
        store: the address as a user wrote it.
        path: its part behind ``sqlite:///``.

    Raises:
        ValueError: with the address that it should be.
    """
    literal = Path(path).expanduser()
    if "?" in path or (urllib.parse.unquote(path) != path and literal.parent.is_dir()):
        raise ValueError(
            f"the path in an SQLite tracking store's address must be percent-encoded (% is %25, ? is %3F), got "
            f"{store!r}, nearest: {sqlite_uri(literal)!r}"
        )


def sqlite_file(uri: str) -> Path | None:
    """The file of a resolved store, None for another kind."""
    path = uri.removeprefix("sqlite:///")
    return None if path == uri else Path(urllib.parse.unquote(path))


@contextlib.contextmanager
def without_stray_folder(uri: str) -> Iterator[None]:
    """Remove the empty folder that MLflow makes for an SQLite file whose address is percent-encoded."""
    stray = Path(uri.removeprefix("sqlite:///")).parent
    is_ours = sqlite_file(uri) is not None and "%" in os.fspath(stray) and not stray.exists()
    yield
    if is_ours:
        with contextlib.suppress(OSError):
            os.removedirs(stray)


@contextlib.contextmanager
def naming_full_disk(uri: str) -> Iterator[None]:
    """Say that the disk of an SQLite file is full, whatever is raised around it.

    Raises:
        DiskFull: instead.
    """
    try:
        yield
    except Exception as error:  # of SQLAlchemy or MLflow, around SQLite's
        file = sqlite_file(uri)
        full = None if file is None else disk_full(error, file.parent)
        if full is None:
            raise
        raise full from error


def create_database(uri: str) -> None:
    """Make a new SQLite file whole or not at all: half of MLflow's tables, of a full disk or a kill, open no more."""
    path = sqlite_file(uri)
    if path is not None and not path.exists():
        for name in (path.name, f"{path.name}-journal"):
            remove_leftovers(path.with_name(name))
        whole(path, _make_tables)


def _make_tables(path: Path) -> None:
    from mlflow.store.db.utils import _initialize_tables
    from sqlalchemy import URL, create_engine
    from sqlalchemy.pool import NullPool

    engine = create_engine(URL.create("sqlite", database=str(path)), poolclass=NullPool)
    try:
        _initialize_tables(engine)
    finally:
        engine.dispose()
