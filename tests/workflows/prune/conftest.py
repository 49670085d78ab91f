"""Every test has a copy of the workshop."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from prune_workshop import WORDS, Workshop


@pytest.fixture(scope="session")
def trained(
    tmp_path_factory: pytest.TempPathFactory, put_tables: Callable[[Path], str], parts_of_one_piece: Path
) -> tuple[Path, dict[str, dict[str, Any]]]:
    folder = tmp_path_factory.mktemp("workshop")
    put_tables(folder / "mlflow.db")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("ATTENTIONVOTE_CACHE", str(parts_of_one_piece))
        workshop = Workshop(folder, {})
        answers = {name: workshop.train(*words) for name, words in WORDS.items()}
    for age_days, name in enumerate(reversed(WORDS)):
        result = (folder / answers[name]["model"]).with_name("result.json")
        when = result.stat().st_mtime - 86_400 * age_days
        os.utime(result, (when, when))
    return folder, answers


@pytest.fixture
def workshop(
    quick_training: None, trained: tuple[Path, dict[str, dict[str, Any]]], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Workshop:  # fmt: skip
    del quick_training
    folder, answers = trained
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return Workshop(tmp_path, answers)
