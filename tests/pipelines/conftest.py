"""What the verbs' tests share: a cache in which every built-in part is one convex piece."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from attentionvote.workflows.settings import GenerateSettings


@pytest.fixture(scope="session")
def parts_of_one_piece(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache folder for verbs in processes of their own, made once for all processes of a test run.

    On a clean machine each would split the brick with coacd first, which takes half a minute. coacd has its own tests,
    and the smoke chain uses it.
    """
    import numpy as np
    from scipy.spatial import ConvexHull

    from attentionvote.command.configuration import compose
    from attentionvote.files import cache_folder
    from attentionvote.simulation.cad import BUILTIN_PARTS
    from attentionvote.simulation.decomposition import hull_file
    from attentionvote.simulation.part_files import load_part

    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "parts-of-one-piece"
    folder.mkdir(exist_ok=True)
    with (folder / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "hulls").exists():
            (folder / "new").mkdir()
            drop = compose(GenerateSettings, ["object=brick"]).simulation.drop
            for name in BUILTIN_PARTS:
                part = load_part(name, f"builtin:{name}")
                piece = part.vertices[ConvexHull(part.vertices).vertices]
                path = hull_file(part, drop.hull_threshold, drop.hull_vertices, folder)
                np.savez(folder / "new" / path.name, hull_000=piece)
            for library in cache_folder().glob("*.so"):  # else everything is compiled again
                shutil.copy(library, folder)
            (folder / "new").rename(folder / "hulls")
    return folder


@pytest.fixture(scope="module")
def store(put_tables: Callable[[Path], str], tmp_path_factory: pytest.TempPathFactory) -> str:
    """Path of a tracking store of the module's own, with MLflow's tables."""
    path = tmp_path_factory.mktemp("tracking") / "mlflow.db"
    put_tables(path)
    return str(path)


@pytest.fixture(scope="module", autouse=True)
def _quick_pieces(parts_of_one_piece: Path) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ATTENTIONVOTE_CACHE", str(parts_of_one_piece))
        yield
